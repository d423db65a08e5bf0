"""Writes a run folder, complete after every view."""

import contextlib
import datetime
import glob
import io
import json
import os
import time
from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from r3jax.checkpoints import Tables, discard, numbered
from r3jax.exploration.config import ExplorationConfig
from r3jax.exploration.state import LoopState, RecordingStopped, Stop
from r3jax.exploration.taken_views import StepRow, TakenView, to_integers
from r3jax.files import (
    NotOursError,
    append_line,
    check_own,
    clear_partial,
    disown_folder,
    is_link,
    is_own,
    lock_folder,
    make_folder,
    own_folder,
    remove,
    remove_own,
    sync_folder,
    write_atomic,
)
from r3jax.frame import Frame
from r3jax.runs.header import RunError, RunHeader, header_to_json, package_versions, read_header
from r3jax.runs.reader import Run, complete_lines, read_run
from r3jax.runs.rows import EndRow, from_json, to_json
from r3jax.runs.stored_states import CheckpointWriter, state_tables
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import read_bytes
from r3jax.validation.json_text import sealed

_MAX_IMAGE_BYTES = 256 << 20
"""No encoded image of a run comes near it."""

# Measured at 512x512: level 2 takes 17 ms and a third of the bytes of level 0 (17 ms); level 6
# saves another tenth and takes 60 ms.
_PNG_LEVEL = 2

_ROOM = ".room"
_ROOM_BYTES = 64 << 10
"""Kept free while a run is written, so that a full disk has room for the row that says so."""

# By name, never a whole tree: what users put into a run survives `overwrite`.
_OWN = (
    "trace.jsonl",
    "timings.jsonl",
    "history.jsonl",
    "transforms.json",
    _ROOM,
    "frames/[0-9]*.png",
    *(
        f"report/{name}.png"
        for name in (
            *("plan", "progress", "reasons", "forecast", "panorama", "views", "cost"),
            *("training", "evaluation"),
        )
    ),
    *(f"report/{name}" for name in ("report.html", "evaluation.json", "evaluation.csv")),
    "report/evaluation.parquet",
    "exports/points.ply",
    *("frames", "checkpoints", "report", "models", "exports"),
)
"""Everything in a run that this package makes, but run.json, the lock, checkpoints and models."""

_OF_MODEL = (
    *("scene.ply", "points.ply", "history.csv", "train.json", "lock", "checkpoints"),
    *("checkpoints/training.json", "checkpoints/lock"),
)
"""The same of a model, but its checkpoints."""


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
        with _named(self.path, "cannot make the run folder"):
            _check_free(self.path, overwrite=overwrite)  # nothing is written where no run may be
            own_folder(self.path, "run")
            with self._locked():
                _check_free(self.path, overwrite=overwrite)  # another process may have been faster
                _clear(self.path)
                for name in ("frames", "report"):
                    make_folder(self.path / name)
                write_atomic(self.path / "trace.jsonl", b"")
                # The last: a folder with a run.json can be gone on with.
                write_atomic(self.path / "run.json", header_to_json(header).encode())
                self._checkpoints = CheckpointWriter(self.path / "checkpoints")
                self._begin(header, views=0)

    @classmethod
    def resume(cls, path: Path | str, header: RunHeader | None = None) -> tuple["RunWriter", Run]:
        """Goes on with a run that was cut off, interrupted or finished.

        What the killed process left half written is cleared away: the torn end of the trace, and
        files under temporary names. The row that says how the run ended moves to history.jsonl.

        Args:
            path: the run folder.
            header: replaces run.json, to give the run another budget; None keeps it.

        Returns:
            The writer, and the run as it was recorded so far.

        Raises:
            RunError: not a run, damaged, being written by another process, or not writable.
        """
        # Not by `__init__`, which would clear the run away.
        writer = cls.__new__(cls)
        writer.path = Path(path)
        read_header(writer.path / "run.json")  # says what is wrong before anything is touched
        with _named(writer.path, "cannot go on with the run"), writer._locked():
            # Read under the lock: until now another process may have added views.
            run = read_run(writer.path)
            own_folder(writer.path, "run")
            for name in ("frames", "report", "exports"):  # refused now, not after an hour
                make_folder(writer.path / name)
            writer._checkpoints = CheckpointWriter(writer.path / "checkpoints")
            _mend(writer.path)  # after the read, which refuses a trace that cannot be mended
            if header is not None:
                write_atomic(writer.path / "run.json", header_to_json(header).encode())
            writer._begin(header or run.header, views=len(run.rows))
        # It has not ended any more.
        return writer, replace(run, header=header or run.header, end=None)

    @contextlib.contextmanager
    def _locked(self):
        """Takes the lock, and keeps it unless the block fails."""
        # The lock is kept beyond this block, by the writer; only a failure in it gives it back.
        try:
            self._lock = lock_folder(self.path)
        except BlockingIOError:
            raise RunError(self.path, "another process is writing this run") from None
        try:
            yield
        except BaseException:
            self._lock.close()
            raise

    def _begin(self, header: RunHeader, *, views: int) -> None:
        self.views = views
        begin = {
            "kind": "begin",
            "time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "views": views,
            "budget": header.budget,
            "packages": package_versions(),
        }
        # The time of day is here and nowhere else: equal runs shall write equal traces.
        append_line(self.path / "history.jsonl", json.dumps(begin))
        # No zeros: some file systems store them in no room at all.
        write_atomic(self.path / _ROOM, os.urandom(_ROOM_BYTES))

    def add(self, row: StepRow, frame: Frame) -> None:
        """Stores one view: the images first, then the row, so that a row's images exist.

        Args:
            row: what the trace says of the view.
            frame: its frame, in stored form.

        Raises:
            RecordingStopped: the disk refused; the views before stay readable.
        """
        rgb, depth = to_integers(frame)
        # Beside each other: the compressor lets other threads run, and the loop waits for both.
        with ThreadPoolExecutor(1) as other:
            depth_png = other.submit(encode_png, depth)
            self._store(row, encode_png(rgb), depth_png.result())

    def adopt(self, row: StepRow, run: Run, step: int) -> None:
        """Stores a view of another run as the next one of this run; its pixels stay as they are.

        Args:
            row: what the trace says of it here.
            run: where its images lie.
            step: its number there.

        Raises:
            RunError: an image cannot be read.
            RecordingStopped: the disk refused.
        """
        try:
            rgb, depth = (
                read_bytes(path, _MAX_IMAGE_BYTES)
                for path in (run.image_path(step), run.depth_path(step))
            )
        except (OSError, ForeignFileError) as error:
            raise RunError(run.path, f"view {step} cannot be read ({error})") from None
        self._store(row, rgb, depth)

    def _store(self, row: StepRow, rgb_png: bytes, depth_png: bytes) -> None:
        # Images, then their names, then the row: whatever moment the power fails at, every row
        # that is there has its images.
        stem = self.path / "frames" / f"{row.step:06d}"
        with self._guarded():
            write_atomic(stem.with_suffix(".png"), rgb_png)
            write_atomic(stem.with_suffix(".depth.png"), depth_png)
            sync_folder(stem.parent)
            append_line(self.path / "trace.jsonl", to_json(row))
            # Counted last: the end row must not count a view whose row the disk refused.
            self.views += 1

    def add_timings(self, step: int, stages: dict[str, float]) -> None:
        """Stores what the stages of one view really took [s], outside the mission clock too."""
        # In a file of its own, and rounded to microseconds: it differs from run to run.
        line = sealed({"step": step, **{k: round(v, 6) for k, v in stages.items()}})
        with self._guarded():
            append_line(self.path / "timings.jsonl", json.dumps(line))

    def checkpoint(self, step: int, tables: Tables, *, wait: bool = False) -> None:
        """Stores the state after view `step` (`stored_states.state_tables`) in the background.

        It is skipped if the state before is still being stored, unless `wait` is True.

        Raises:
            RecordingStopped: the disk refused the checkpoint before, or with `wait` this one.
        """
        with self._guarded():
            self._checkpoints.save(step, tables, wait=wait)

    def finish(self, outcome: str, message: str) -> None:
        """Stores how the run ended, on a full disk in the room that was kept for it.

        Raises:
            RecordingStopped: the disk refused this, or a checkpoint that was under way.
        """
        with self._guarded(), contextlib.ExitStack() as afterwards:
            # Also if the row fails: a checkpoint that is under way is told of, and not dropped.
            afterwards.callback(self._checkpoints.wait)
            # Freed first: on a full disk this room is all there is for the row.
            remove(self.path / _ROOM)
            append_line(self.path / "trace.jsonl", to_json(EndRow(outcome, message, self.views)))

    def record_view(self, view: TakenView, state: LoopState, config: ExplorationConfig) -> None:
        """Stores one view, and begins to store the state after it.

        Raises:
            RecordingStopped: the disk refused; the views before stay readable.
        """
        begin = time.perf_counter()
        # The view first: a resume ignores a checkpoint that has no row, and can do without one.
        self.add(view.row, view.frame)
        if not view.row.captured and state.chosen % config.checkpoint_every == 0:
            self.checkpoint(view.row.step, state_tables(state))
        seconds = time.perf_counter() - begin
        self.add_timings(view.row.step, view.stages | {"record": seconds})

    def record_end(self, state: LoopState, stop: Stop) -> Stop:
        """Stores the last state and how the run ended; a full disk may refuse even that.

        Returns:
            The end, with what could not be stored in its message.
        """
        try:
            if state.views > 0:
                # Before the end row, whose message can then say that this map is missing.
                self.checkpoint(state.views - 1, state_tables(state), wait=True)
        except RecordingStopped as error:  # the frames stay, and the map can be made of them again
            # The full disk that ended the run is not reported twice.
            if error.reason not in stop.message:
                message = f"{stop.message}; the last map is not stored ({error.reason})"
                stop = replace(stop, message=message)
        try:
            self.finish(stop.reason.value, stop.message)
        except RecordingStopped as error:
            # For the caller only: on the disk the run looks cut off, and can be resumed.
            return replace(
                stop, message=f"{stop.message}; the end is not recorded ({error.reason})"
            )
        return stop

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
        """Frees the threads and the lock."""
        try:
            # Before the lock goes: a thread that still writes would meet the next process.
            self._checkpoints.close()
            # A disk that has become read-only refuses this; the run is complete nevertheless.
            with contextlib.suppress(OSError):
                remove(self.path / _ROOM)
        finally:
            self._lock.close()

    def __enter__(self) -> "RunWriter":
        """Returns the writer itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Frees the lock, whatever happened."""
        self.close()


@contextlib.contextmanager
def _named(path: Path, what: str) -> Generator[None]:
    """Says of a run what the system refuses."""
    try:
        yield
    except NotOursError as error:
        raise RunError(error.path, error.reason) from error
    except OSError as error:
        raise RunError(path, f"{what} ({error.strerror or error})") from error


def encode_png(image: np.ndarray) -> bytes:
    """Encodes an image, [H, W, 3] uint8 or [H, W] uint16, as PNG."""
    from PIL import Image  # a run is read without images more often than with them

    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="png", compress_level=_PNG_LEVEL)
    return buffer.getvalue()


def _mend(path: Path) -> None:
    """Leaves the whole rows of views in the trace, and nothing half written anywhere."""
    trace = path / "trace.jsonl"
    views: list[str] = []
    for line in complete_lines(trace):
        if isinstance(from_json(line), StepRow):
            views.append(line)
        else:
            # How the run ended before is kept: the trace holds one end, and only as its last row.
            append_line(path / "history.jsonl", line)
    # A trace that is whole is not touched.
    whole = "".join(f"{line}\n" for line in views).encode()
    if trace.read_bytes() != whole:
        write_atomic(trace, whole)
    # Only its torn end: the next line would be glued to it, and both would be lost.
    timings = path / "timings.jsonl"
    if timings.exists() and not timings.read_bytes().endswith(b"\n"):
        write_atomic(timings, "".join(f"{line}\n" for line in complete_lines(timings)).encode())
    clear_partial(path)


def _check_free(path: Path, *, overwrite: bool) -> None:
    """Says why no new run may begin here.

    Raises:
        RunError: a file, something that is not a run, or a run that may not be overwritten.
    """
    if path.exists() and not path.is_dir():
        raise RunError(path, "is a file; a run needs a folder")
    check_own(path, "run", "choose another name")
    if (path / "run.json").exists() and not overwrite:
        raise RunError(path, "the run exists already: choose another name or give --overwrite")


def _clear(path: Path) -> None:
    """Deletes the run that is there, but for run.json, which the new one replaces."""
    for old in numbered(path / "checkpoints"):
        discard(old)
    models = path / "models"
    for model in [] if is_link(models) else models.glob("*"):
        if not is_link(model) and is_own(model, "model"):
            for old in numbered(model / "checkpoints"):
                discard(old)
            disown_folder(model / "checkpoints")
            disown_folder(model)
            remove_own(models, [f"{glob.escape(model.name)}/{name}" for name in _OF_MODEL])
    clear_partial(path)
    remove_own(path, _OWN)
