"""Writes a run folder, complete after every view."""

import contextlib
import fcntl
import json
import shutil
from pathlib import Path
from types import TracebackType

from r3jax.files import append_line, sync_folder, write_atomic
from r3jax.frame import Frame
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.trace.checkpoints import save_checkpoint
from r3jax.trace.errors import RecordingStopped, RunError
from r3jax.trace.header import RunHeader, header_to_json
from r3jax.trace.images import encode_png, to_integers
from r3jax.trace.rows import EndRow, StepRow, to_json

_CONTENT = (
    "run.json",
    "trace.jsonl",
    "timings.jsonl",
    "transforms.json",
    "frames",
    "checkpoints",
    "report",
    "models",
    "exports",
)


class RunWriter:
    """The one writer of a run folder. A context manager: leaving it frees the lock."""

    def __init__(self, path: Path, header: RunHeader, *, overwrite: bool = False):
        """Makes the folder and writes run.json.

        Args:
            path: the run folder, `runs/NAME`.
            header: what fixes the run.
            overwrite: delete the run that is there. A folder that holds anything but a run is
                never deleted.

        Raises:
            RunError: the folder exists and may not be overwritten, is not a run, is being
                written by another process, or cannot be made.
        """
        self.path = Path(path)
        self.views = 0
        try:
            if self.path.exists():
                _clear(self.path, overwrite=overwrite)
            for name in ("frames", "report"):
                (self.path / name).mkdir(parents=True, exist_ok=True)
            write_atomic(self.path / "run.json", header_to_json(header).encode())
            self._lock = _lock(self.path / "run.json")
            (self.path / "trace.jsonl").touch()
        except OSError as error:
            raise RunError(self.path, f"cannot make the run folder ({error.strerror})") from error

    def add(self, row: StepRow, frame: Frame) -> None:
        """Stores one view: the images first, then the row, so that a row's images exist.

        Args:
            row: what the trace says of the view.
            frame: its frame, in stored form.

        Raises:
            RecordingStopped: the disk refused; the views before stay readable.
        """
        rgb, depth = to_integers(frame)
        stem = self.path / "frames" / f"{row.step:06d}"
        with self._guarded():
            write_atomic(stem.with_suffix(".png"), encode_png(rgb))
            write_atomic(stem.with_suffix(".depth.png"), encode_png(depth))
            sync_folder(stem.parent)
            append_line(self.path / "trace.jsonl", to_json(row))
            self.views += 1

    def add_timings(self, step: int, stages: dict[str, float]) -> None:
        """Stores what the stages of one view really took [s], outside the mission clock too."""
        line = json.dumps({"step": step, **{k: round(v, 6) for k, v in stages.items()}})
        with self._guarded(), open(self.path / "timings.jsonl", "a", encoding="utf-8") as file:
            file.write(line + "\n")

    def checkpoint(self, step: int, map_state: MapState, grid: OccupancyGrid) -> None:
        """Stores the map and the grid as they are after view `step`."""
        with self._guarded():
            save_checkpoint(self.path / "checkpoints", step, map_state, grid)

    def finish(self, outcome: str, message: str) -> None:
        """Stores how the run ended."""
        with self._guarded():
            append_line(self.path / "trace.jsonl", to_json(EndRow(outcome, message, self.views)))

    @contextlib.contextmanager
    def _guarded(self):
        try:
            yield
        except OSError as error:
            reason = error.strerror or str(error)
            raise RecordingStopped(
                Path(error.filename or self.path),
                f"cannot write ({reason}); everything recorded before it is complete",
            ) from error

    def close(self) -> None:
        """Frees the lock."""
        self._lock.close()

    def __enter__(self) -> "RunWriter":
        """The writer itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Frees the lock, whatever happened."""
        self.close()


def _lock(path: Path):
    """An exclusive lock that dies with the process, so that none is ever stale."""
    file = open(path, "rb")  # noqa: SIM115 (held open on purpose: closing it frees the lock)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        raise RunError(path, "another process is writing this run") from None
    return file


def _clear(path: Path, *, overwrite: bool) -> None:
    """Makes room for a new run, or says why not."""
    if not path.is_dir():
        raise RunError(path, "is a file; a run needs a folder")
    present = {entry.name for entry in path.iterdir()}
    if not present:
        return
    if "run.json" not in present:
        raise RunError(path, "the folder holds something that is not a run: choose another name")
    if not overwrite:
        raise RunError(path, "the run exists already: choose another name or give --overwrite")
    with _lock(path / "run.json"):
        for name in _CONTENT:
            target = path / name
            if target.is_dir() and not target.is_symlink():
                shutil.rmtree(target)
            else:
                target.unlink(missing_ok=True)
