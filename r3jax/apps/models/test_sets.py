"""The views that judge a model, and those that its map is made of."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from r3jax.apps.models.folder import TrainedModel
from r3jax.formats.captures import Capture, open_capture
from r3jax.formats.errors import FormatError
from r3jax.frame import Frame


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


def choose_views(
    spec: str, capture: Capture, model: TrainedModel, up: Literal["y", "z"] = "y"
) -> TestSet:
    """Finds the views that judge a model.

    Args:
        spec: `heldout`, `all`, `every:N`, or the folder of another capture of the place.
        capture: what the model was looked up for.
        model: the model.
        up: axis of another recording's world that points up.

    Raises:
        ValueError: `spec` is none of these.
        FormatError: there are no such views.
        RunError: the other capture is a damaged run.
    """
    count, seen = len(capture), model.train_views
    if spec == "heldout":
        numbers = _held_out(capture, model)
        return TestSet(capture, numbers, "held-out views", 0)
    if spec == "all" or spec.startswith("every:"):
        step = 1 if spec == "all" else _whole_number(spec)
        numbers = list(range(0, count, step))
        if not numbers:
            raise FormatError(capture.path, "it holds no views")
        title = "views (all)" if step == 1 else f"views (one in {step})"
        return TestSet(capture, numbers, title, _overlap(numbers, seen))
    if not Path(spec).is_dir():
        raise ValueError(
            f"--views takes heldout, all, every:N or the folder of another run, got {spec!r}"
        )
    other = open_capture(Path(spec), up)
    if len(other) == 0:
        raise FormatError(Path(spec), "it holds no views")
    is_same = other.path.resolve() == capture.path.resolve()
    numbers = list(range(len(other)))
    return TestSet(other, numbers, "views", _overlap(numbers, seen) if is_same else 0)


def _held_out(capture: Capture, model: TrainedModel) -> list[int]:
    if not model.is_here:
        why = "there is no train.json beside it" if not model.record else "it is of other data"
        raise FormatError(
            model.path,
            f"which views of {capture.path} were held out is not known ({why}); "
            "use --views all, every:N or another run",
        )
    numbers = list(model.record.get("test_views", []))
    if not numbers:
        raise FormatError(
            model.path,
            "it was trained on all views; train with --hold-out 8, or use --views with another "
            "run of the place",
        )
    if max(numbers) >= len(capture):
        raise FormatError(
            model.path,
            f"it holds out view {max(numbers)}, but {capture.path} has {len(capture)} views: it "
            "was trained on an earlier content; train it again",
        )
    return numbers


def _whole_number(spec: str) -> int:
    text = spec.removeprefix("every:")
    if not text.isdecimal() or int(text) < 1:
        raise ValueError(f"--views every:N takes a whole number of at least 1, got {spec!r}")
    return int(text)


def _overlap(numbers: list[int], seen: list[int] | None) -> int | None:
    return None if seen is None else len(set(numbers) & set(seen))


def mapped_views(model: TrainedModel, test: TestSet, capture: Capture) -> list[int]:
    """Views of the capture for the map: those trained on; none if the capture is other data.

    Without a train.json all views but the tested ones, as a model of them most likely saw them.
    """
    if model.train_views is not None:
        return [number for number in model.train_views if number < len(capture)]
    if model.record:
        return []
    tested: set[int] = set(test.numbers) if test.capture is capture else set()
    return [number for number in range(len(capture)) if number not in tested]


def frames_of(capture: Capture, numbers: list[int]) -> Iterator[Frame]:
    """Some frames of a capture, read one by one."""
    return (capture.source.frame(number) for number in numbers)
