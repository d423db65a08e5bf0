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
"""Maximum size of an encoded image."""

# Measured at 512x512: level 2 takes 17 ms and a third of the bytes of level 0 (17 ms); level 6
# saves another tenth and takes 60 ms.
_PNG_LEVEL = 2

_TILES_EVERY = 20
"""Views between two checkpoints of a run with tiles, at least."""

_ROOM = ".room"
_ROOM_BYTES = 64 << 10
"""Space reserved while a run is written, so that a full disk has space for the final row."""

# By name, never a whole tree: users' files in a run survive `overwrite`.
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
"""Everything that this package writes into a run, except run.json, the lock, checkpoints and
models."""

_OF_MODEL = (
    *("scene.ply", "points.ply", "history.csv", "train.json", "lock", "checkpoints"),
    *("checkpoints/training.json", "checkpoints/lock"),
)
"""The same for a model, except its checkpoints."""


class RunWriter:
    """Writes a run folder, exclusively. A context manager that holds the folder's lock."""

    def __init__(self, path: Path, header: RunHeader, *, overwrite: bool = False):
        """Makes the folder and writes run.json.

        Args:
            path: the run folder, `runs/NAME`.
            header: of the run.
            overwrite: delete an existing run. A folder that is not a run is never deleted.

        Raises:
            RunError: the folder exists and may not be overwritten, is not a run, is being
                written by another process, or cannot be made.
        """
        self.path = Path(path)
        with _named(self.path, "cannot make the run folder"):
            _check_free(self.path, overwrite=overwrite)  # nothing is written if no run may be there
            own_folder(self.path, "run")
            with self._locked():
                _check_free(self.path, overwrite=overwrite)  # another process may have been faster
                _clear(self.path)
                for name in ("frames", "report"):
                    make_folder(self.path / name)
                write_atomic(self.path / "trace.jsonl", b"")
                # Last: a folder with a run.json can be resumed.
                write_atomic(self.path / "run.json", header_to_json(header).encode())
                self._checkpoints = CheckpointWriter(self.path / "checkpoints")
                self._begin(header, views=0)

    @classmethod
    def resume(cls, path: Path | str, header: RunHeader | None = None) -> tuple["RunWriter", Run]:
        """Goes on with a run that was cut off, interrupted or finished.

        Partial writes of a killed process are removed: an incomplete last line of the trace, and
        temporary files. The row about the end of the run moves to history.jsonl.

        Args:
            path: the run folder.
            header: replaces run.json, for example with another budget; None keeps it.

        Returns:
            The writer, and the run recorded so far.

        Raises:
            RunError: not a run, damaged, being written by another process, or not writable.
        """
        # Not by `__init__`, which would delete the run.
        writer = cls.__new__(cls)
        writer.path = Path(path)
        read_header(writer.path / "run.json")  # reports errors before anything is changed
        with _named(writer.path, "cannot go on with the run"), writer._locked():
            # Read under the lock: until now another process may have added views.
            run = read_run(writer.path)
            own_folder(writer.path, "run")
            for name in (
                "frames",
                "report",
                "exports",
            ):  # refused now, not after an hour of exploration
                make_folder(writer.path / name)
            writer._checkpoints = CheckpointWriter(writer.path / "checkpoints")
            _mend(writer.path)  # after reading, which refuses a trace beyond repair
            if header is not None:
                write_atomic(writer.path / "run.json", header_to_json(header).encode())
            writer._begin(header or run.header, views=len(run.rows))
        # The run has not ended any more.
        return writer, replace(run, header=header or run.header, end=None)

    @contextlib.contextmanager
    def _locked(self):
        """Acquires the lock, and keeps it unless the block fails."""
        # The writer holds the lock beyond this block; only a failure releases it.
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
        # The time of day is only here, so that equal runs write equal traces.
        append_line(self.path / "history.jsonl", json.dumps(begin))
        # No zeros: some file systems store them without using space.
        write_atomic(self.path / _ROOM, os.urandom(_ROOM_BYTES))

    def add(self, row: StepRow, frame: Frame) -> None:
        """Stores one view: the images first, then the row, so that a row's images exist.

        Args:
            row: its row in the trace.

            frame: its frame, in stored form.

        Raises:
            RecordingStopped: the disk refused; the views before stay readable.
        """
        rgb, depth = to_integers(frame)
        # In parallel: compression releases the lock of Python, and the loop waits for both.
        with ThreadPoolExecutor(1) as other:
            depth_png = other.submit(encode_png, depth)
            self._store(row, encode_png(rgb), depth_png.result())

    def adopt(self, row: StepRow, run: Run, step: int) -> None:
        """Stores a view of another run as the next one of this run, with the same pixels.

        Args:
            row: its row in this trace.

            run: the other run.

            step: its number there.

        Raises:
            RunError: an image cannot be read.
            RecordingStopped: writing failed.
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
        # Images, then their names, then the row: even after a power failure every row has its
        # images.
        stem = self.path / "frames" / f"{row.step:06d}"
        with self._guarded():
            write_atomic(stem.with_suffix(".png"), rgb_png)
            write_atomic(stem.with_suffix(".depth.png"), depth_png)
            sync_folder(stem.parent)
            append_line(self.path / "trace.jsonl", to_json(row))
            # Counted last: the end row must not count a view whose row could not be written.
            self.views += 1

    def add_timings(self, step: int, stages: dict[str, float]) -> None:
        """Stores the measured times of all stages of one view [s]."""
        # In a separate file, and rounded to microseconds: times differ between runs.
        line = sealed({"step": step, **{k: round(v, 6) for k, v in stages.items()}})
        with self._guarded():
            append_line(self.path / "timings.jsonl", json.dumps(line))

    def checkpoint(self, step: int, tables: Tables, *, wait: bool = False) -> None:
        """Stores the state after view `step` (`stored_states.state_tables`) in the background.

        It is skipped if the previous state is still being stored, unless `wait` is True.

        Raises:
            RecordingStopped: writing the previous checkpoint, or with `wait` this one, failed.
        """
        with self._guarded():
            self._checkpoints.save(step, tables, wait=wait)

    def finish(self, outcome: str, message: str) -> None:
        """Stores how the run ended, on a full disk in the reserved space.

        Raises:
            RecordingStopped: writing this, or a checkpoint in progress, failed.
        """
        with self._guarded(), contextlib.ExitStack() as afterwards:
            # Also if the row fails: errors of a checkpoint in progress are reported.
            afterwards.callback(self._checkpoints.wait)
            # Freed first: on a full disk this is the only space for the row.
            remove(self.path / _ROOM)
            append_line(self.path / "trace.jsonl", to_json(EndRow(outcome, message, self.views)))

    def record_view(self, view: TakenView, state: LoopState, config: ExplorationConfig) -> None:
        """Stores one view, and starts storing the state after it.

        Raises:
            RecordingStopped: the disk refused; the views before stay readable.
        """
        begin = time.perf_counter()
        # The view first: when resuming, a checkpoint without a row is ignored.
        self.add(view.row, view.frame)
        every = config.checkpoint_every
        if config.tiles:  # all tiles are written again: time that the next views would miss
            every = max(every, _TILES_EVERY)
        if not view.row.captured and state.chosen % every == 0:
            self.checkpoint(view.row.step, state_tables(state))
        seconds = time.perf_counter() - begin
        self.add_timings(view.row.step, view.stages | {"record": seconds})

    def record_end(self, state: LoopState, stop: Stop) -> Stop:
        """Stores the last state and how the run ended; on a full disk even that may fail.

        Returns:
            The end, with failures added to its message.
        """
        try:
            if state.views > 0:
                # Before the end row, so that its message can mention a missing map.
                self.checkpoint(state.views - 1, state_tables(state), wait=True)
        except (
            RecordingStopped
        ) as error:  # the map can be rebuilt from the frames; a full disk is not reported twice
            if error.reason not in stop.message:
                message = f"{stop.message}; the last map is not stored ({error.reason})"
                stop = replace(stop, message=message)
        try:
            self.finish(stop.reason.value, stop.message)
        except RecordingStopped as error:
            # For the caller only: on disk the run looks interrupted, and can be resumed.
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
            # Before releasing the lock, so that no thread still writes for the next process.
            self._checkpoints.close()
            # Fails on a disk that has become read-only; the run is complete anyway.
            with contextlib.suppress(OSError):
                remove(self.path / _ROOM)
        finally:
            self._lock.close()

    def __enter__(self) -> "RunWriter":
        """Returns the writer itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Releases the lock in any case."""
        self.close()


@contextlib.contextmanager
def _named(path: Path, what: str) -> Generator[None]:
    """Converts errors of the system to a `RunError` of the run."""
    try:
        yield
    except NotOursError as error:
        raise RunError(error.path, error.reason) from error
    except OSError as error:
        raise RunError(path, f"{what} ({error.strerror or error})") from error


def encode_png(image: np.ndarray) -> bytes:
    """Encodes an image, [H, W, 3] uint8 or [H, W] uint16, as PNG."""
    from PIL import Image  # lazy: runs are mostly read without images

    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="png", compress_level=_PNG_LEVEL)
    return buffer.getvalue()


def _mend(path: Path) -> None:
    """Keeps the complete rows of views in the trace, and removes partial writes."""
    trace = path / "trace.jsonl"
    views: list[str] = []
    for line in complete_lines(trace):
        if isinstance(from_json(line), StepRow):
            views.append(line)
        else:
            # The earlier end is moved: a trace has one end, as its last row.
            append_line(path / "history.jsonl", line)
    # A complete trace is not changed.
    whole = "".join(f"{line}\n" for line in views).encode()
    if trace.read_bytes() != whole:
        write_atomic(trace, whole)
    # Only its incomplete last line, which would be joined with the next one.
    timings = path / "timings.jsonl"
    if timings.exists() and not timings.read_bytes().endswith(b"\n"):
        write_atomic(timings, "".join(f"{line}\n" for line in complete_lines(timings)).encode())
    clear_partial(path)


def _check_free(path: Path, *, overwrite: bool) -> None:
    """Refuses a folder in which no new run may begin.

    Raises:
        RunError: a file, something that is not a run, or a run that may not be overwritten.
    """
    if path.exists() and not path.is_dir():
        raise RunError(path, "is a file; a run needs a folder")
    check_own(path, "run", "choose another name")
    if (path / "run.json").exists() and not overwrite:
        raise RunError(path, "the run exists already: choose another name or give --overwrite")


def _clear(path: Path) -> None:
    """Deletes an existing run, except run.json, which the new one replaces."""
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
