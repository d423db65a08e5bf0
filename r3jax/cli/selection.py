"""Which model `r3jax evaluate` judges, and by which views."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from r3jax.cli.captures import Capture, open_capture
from r3jax.cli.errors import UserError, one_line
from r3jax.cli.options import Evaluate
from r3jax.formats.validation.errors import ForeignFileError
from r3jax.formats.validation.fields import check_type
from r3jax.formats.validation.files import read_bytes
from r3jax.formats.validation.json_text import parse_json, unsealed
from r3jax.formats.validation.versions import check_version
from r3jax.frame import Frame

_MAX_BYTES = 64 << 20

RECORD_FORMAT = 1
"""Format version of train.json."""

_KINDS = {
    "data": str,
    "resolution": int,
    "train_views": list[int],
    "test_views": list[int],
    "config": dict[str, Any],
}
"""What is used of train.json."""


@dataclass(frozen=True)
class Training:
    """What is known of a model's training, from the train.json beside it."""

    model: Path
    """The PLY file."""

    record: dict[str, Any]
    """Empty if there is no train.json."""

    is_here: bool
    """True if the model was trained on the capture that is evaluated."""

    @property
    def train_views(self) -> list[int] | None:
        """Numbers of the views trained on, in the capture; None if not known."""
        return self.record.get("train_views") if self.is_here else None

    @property
    def background(self) -> np.ndarray:
        """What the training had behind everything; black if that was random."""
        is_white = self.record.get("config", {}).get("background") == "white"
        return np.full(3, 1.0 if is_white else 0.0, dtype=np.float32)


@dataclass(frozen=True)
class TestSet:
    """The views that judge."""

    capture: Capture
    numbers: list[int]
    """In the capture."""

    title: str
    """As the table calls them."""

    num_trained: int | None
    """How many of them the model has seen; None if not known."""

    def frames(self) -> Iterator[Frame]:
        """Every frame in order, as recorded."""
        return frames_of(self.capture, self.numbers)


def find_training(options: Evaluate, capture: Capture) -> Training:
    """The model and what is known of it."""
    model = options.model or capture.models / options.name / "scene.ply"
    if model.is_dir():
        model = model / "scene.ply"
    if not model.is_file():
        found = sorted(path.parent.name for path in capture.models.glob("*/scene.ply"))
        known = f"there are: {', '.join(found)} (--name)" if found else "there is none yet"
        raise UserError(
            f"{model}: there is no such model; {known}; `r3jax train {capture.path}` makes one"
        )
    path = model.parent / "train.json"
    try:
        record = _read_record(path) if path.exists() else {}
    except (ForeignFileError, OSError) as error:
        raise UserError(f"{path}: the file cannot be read ({one_line(error)})") from error
    is_inside = capture.models.resolve() in model.resolve().parents
    is_same = "data" in record and Path(record["data"]).resolve() == capture.path.resolve()
    return Training(model, record, bool(record) and (is_inside or is_same))


def _read_record(path: Path) -> dict[str, Any]:
    """train.json, with what is used of it checked.

    Raises:
        ForeignFileError: it is damaged.
        OSError: it cannot be read.
    """
    record = parse_json(read_bytes(path, _MAX_BYTES))
    check_type("train.json", record, dict[str, Any])
    check_version(record.get("format", 1), RECORD_FORMAT)  # the first ones did not say
    record = unsealed(record)
    for name, kind in _KINDS.items():
        if name in record:
            check_type(name, record[name], kind)
    for name in ("train_views", "test_views"):
        if min(record.get(name, ()), default=0) < 0:
            raise ForeignFileError(f"`{name}` holds a negative number")
    if record.get("resolution", 1) < 1 or "\0" in record.get("data", ""):
        raise ForeignFileError("`resolution` or `data` makes no sense")
    return record


def choose_views(options: Evaluate, capture: Capture, training: Training) -> TestSet:
    """The views that `--views` means."""
    spec, count = options.views, len(capture)
    seen = training.train_views
    if spec == "heldout":
        numbers = _held_out(capture, training)
        return TestSet(capture, numbers, "held-out views", 0)
    if spec == "all" or spec.startswith("every:"):
        step = 1 if spec == "all" else _whole_number(spec)
        numbers = list(range(0, count, step))
        if not numbers:
            raise UserError(f"{capture.path} holds no views")
        title = "views (all)" if step == 1 else f"views (one in {step})"
        return TestSet(capture, numbers, title, _overlap(numbers, seen))
    if not Path(spec).is_dir():
        raise UserError(
            f"--views takes heldout, all, every:N or the folder of another run, got {spec!r}"
        )
    other = open_capture(Path(spec), options.up)
    if len(other) == 0:
        raise UserError(f"{spec} holds no views")
    is_same = other.path.resolve() == capture.path.resolve()
    numbers = list(range(len(other)))
    return TestSet(other, numbers, "views", _overlap(numbers, seen) if is_same else 0)


def _held_out(capture: Capture, training: Training) -> list[int]:
    if not training.is_here:
        why = "there is no train.json beside it" if not training.record else "it is of other data"
        raise UserError(
            f"{training.model}: which views of {capture.path} were held out is not known ({why}); "
            "use --views all, every:N or another run"
        )
    numbers = list(training.record.get("test_views", []))
    if not numbers:
        raise UserError(
            f"{training.model} was trained on all views; train with --hold-out 8, or use --views "
            "with another run of the place"
        )
    if max(numbers) >= len(capture):
        raise UserError(
            f"{training.model} holds out view {max(numbers)}, but {capture.path} has "
            f"{len(capture)} views: it was trained on an earlier content; train it again"
        )
    return numbers


def _whole_number(spec: str) -> int:
    text = spec.removeprefix("every:")
    if not text.isdecimal() or int(text) < 1:
        raise UserError(f"--views every:N takes a whole number of at least 1, got {spec!r}")
    return int(text)


def _overlap(numbers: list[int], seen: list[int] | None) -> int | None:
    return None if seen is None else len(set(numbers) & set(seen))


def mapped_views(training: Training, test: TestSet, capture: Capture) -> list[int]:
    """Views of the capture for the map: those trained on; none if the capture is other data.

    Without a train.json all views but the tested ones, as a model of them most likely saw them.
    """
    if training.train_views is not None:
        return [number for number in training.train_views if number < len(capture)]
    if training.record:
        return []
    tested: set[int] = set(test.numbers) if test.capture is capture else set()
    return [number for number in range(len(capture)) if number not in tested]


def frames_of(capture: Capture, numbers: list[int]) -> Iterator[Frame]:
    """Some frames of a capture, read one by one."""
    return (capture.source.frame(number) for number in numbers)
