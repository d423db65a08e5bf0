"""Reads a run folder: settings and rows immediately, images on demand."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from r3jax.exploration.state import LoopState
from r3jax.exploration.taken_views import StepRow, content_hash, from_integers
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.mapping.config import mapping_config_of
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.runs.header import RunError, RunHeader, read_header
from r3jax.runs.rows import EndRow, from_json
from r3jax.runs.stored_states import (
    checkpoint_steps,
    load_checkpoint,
    newest_state,
    read_checkpoint,
)
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import read_bytes
from r3jax.validation.images import image_pixels
from r3jax.validation.json_text import check_type, parse_json, unsealed

_MAX_BYTES = 256 << 20
"""Maximum size of a trace, which has some kilobytes per view."""

_MAX_LINES = 1 << 20
"""Maximum number of lines of a trace."""


@dataclass(frozen=True)
class Run:
    """A run on disk, possibly interrupted at any moment."""

    path: Path
    header: RunHeader
    rows: tuple[StepRow, ...]
    """One per view, in order."""

    end: EndRow | None
    """How the run ended; None if it was killed or is still running."""

    timings: tuple[dict[str, float], ...]
    """Times per stage [s], one entry per view if written."""

    @property
    def camera(self) -> Camera:
        """The camera of every frame."""
        return self.header.intrinsics

    @property
    def outcome(self) -> str:
        """How the run ended, in a sentence."""
        if self.end is None:
            return "cut off: the run has no final row (killed, or still running)"
        return f"{self.end.outcome}: {self.end.message}"

    def image_path(self, step: int) -> Path:
        """Returns the path of the color image of a view."""
        return self.path / "frames" / f"{step:06d}.png"

    def depth_path(self, step: int) -> Path:
        """Returns the path of the depth image of a view."""
        return self.path / "frames" / f"{step:06d}.depth.png"

    def frame(self, step: int) -> Frame:
        """Reads the frame of one view, as it entered the map.

        Raises:
            RunError: an image is missing, broken, or not the one that was recorded.
        """
        return from_integers(*self.images(step), self.rows[step].pose, self.camera)

    def images(self, step: int) -> tuple[np.ndarray, np.ndarray]:
        """Reads the stored images of one view: [H, W, 3] uint8 and [H, W] uint16.

        Raises:
            RunError: an image is missing, broken, or not the one that was recorded.
        """
        size = (self.camera.width, self.camera.height)
        rgb = read_png(self.image_path(step), *size, is_depth=False)
        depth = read_png(self.depth_path(step), *size, is_depth=True)
        # PNG has its own checksum, but it does not detect edited files or those of other runs.
        if content_hash(rgb, depth) != self.rows[step].sha256:
            raise RunError(self.image_path(step), "the pixels differ from those recorded")
        return rgb, depth

    def frames(self) -> Iterator[Frame]:
        """Iterates over every frame in order, reading one at a time."""
        return (self.frame(row.step) for row in self.rows)

    def checkpoint(self) -> tuple[int, MapState, OccupancyGrid]:
        """Reads the newest stored map and grid, and the view after which they were stored.

        Of a run with tiles the whole map, and the whole grid.
        """
        try:
            mapping = mapping_config_of(self.header.config)
        except (TypeError, ValueError) as error:
            raise RunError(self.path / "run.json", f"a setting of the loop: {error}") from None
        return read_checkpoint(self.path / "checkpoints", mapping, self.camera)

    def checkpoint_steps(self) -> list[int]:
        """Lists the views with a checkpoint, oldest first."""
        return checkpoint_steps(self.path / "checkpoints")

    def load_checkpoint(self, step: int) -> dict[str, dict[str, np.ndarray]]:
        """Reads the arrays of a checkpoint, by table.

        Raises:
            RunError: that view has no checkpoint, or it cannot be read.
        """
        return load_checkpoint(self.path / "checkpoints", step)

    def newest_state(self, start: LoopState) -> LoopState:
        """Reads the newest usable checkpoint; returns `start` if there is none."""
        return newest_state(self.path / "checkpoints", self.rows, start)


def read_run(path: Path | str) -> Run:
    """Reads a run folder; an interrupted run is read up to its last complete row.

    Raises:
        RunError: not a run, another format version, or a row that is damaged.
    """
    path = Path(path)
    header = read_header(path / "run.json")
    rows: list[StepRow] = []
    end: EndRow | None = None
    for number, line in enumerate(complete_lines(path / "trace.jsonl"), start=1):
        try:
            row = from_json(line)
        except ForeignFileError as error:
            raise RunError(path / "trace.jsonl", f"line {number}: {error}") from None
        # Rows of views are numbered, to detect lost lines; the end has no number.
        if isinstance(row, EndRow):
            end = row
        elif row.step != len(rows):
            raise RunError(
                path / "trace.jsonl",
                f"line {number}: expected view {len(rows)}, found view {row.step}",
            )
        else:
            rows.append(row)
    return Run(path, header, tuple(rows), end, _read_timings(path / "timings.jsonl"))


def read_png(path: Path, width: int, height: int, *, is_depth: bool) -> np.ndarray:
    """Reads a stored image, [H, W, 3] uint8 or [H, W] uint16.

    Raises:
        RunError: the file is missing, broken, of another size or of another kind.
    """
    kind, modes = ("16-bit depth", ("I;16", "I")) if is_depth else ("8-bit RGB", ("RGB",))
    try:
        pixels = image_pixels(path, ["PNG"], (width, height), modes, f"expected {kind}")
    except FileNotFoundError:
        raise RunError(path, "the image is missing") from None
    except OSError as error:
        raise RunError(path, f"the image cannot be read ({error.strerror})") from None
    except ForeignFileError as error:
        raise RunError(path, str(error)) from None
    return pixels.astype(np.uint16) if is_depth else pixels


def complete_lines(path: Path) -> list[str]:
    """Reads the lines that end in a newline: a power cut may have torn the last one.

    Raises:
        RunError: missing, not permitted, or larger than any trace.
    """
    try:
        data = read_bytes(path, _MAX_BYTES)
    except FileNotFoundError:
        raise RunError(path, "the file is missing") from None
    except OSError as error:
        raise RunError(path, f"the file cannot be read ({error.strerror})") from None
    except ForeignFileError as error:
        raise RunError(path, str(error)) from None
    # Counted before splitting: short lines take many times their size as strings.
    if data.count(b"\n") > _MAX_LINES:
        raise RunError(path, f"the file has more than {_MAX_LINES} lines: not a trace")
    # Replaced, not refused: the parser reports the damaged line by its number. Split at \n only:
    # `splitlines` would also split at separators inside a text.
    return data.decode("utf-8", errors="replace").split("\n")[:-1]


def _read_timings(path: Path) -> tuple[dict[str, float], ...]:
    """Reads the timings, skipping unreadable lines."""
    # Merged runs have none, and neither does a process that was killed early.
    if not path.exists():
        return ()
    timings: list[dict[str, float]] = []
    for line in complete_lines(path):
        try:
            plain = parse_json(line)
            # Twice: the seal, a text among the numbers, is removed in between.
            check_type("timings", plain, dict[str, Any])
            plain = unsealed(plain)
            check_type("timings", plain, dict[str, float])
        except ForeignFileError:
            continue
        timings.append({name: float(seconds) for name, seconds in plain.items()})
    return tuple(timings)
