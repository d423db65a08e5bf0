"""`r3jax evaluate`: judges a model by test views and writes what came out."""

import dataclasses
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Table

from r3jax.cli.captures import Capture, open_capture
from r3jax.cli.errors import UserError, one_line
from r3jax.cli.options import Evaluate
from r3jax.evaluation import scores, style
from r3jax.evaluation.contact_sheet import SheetView, contact_sheet
from r3jax.evaluation.judge import Judgment, judge
from r3jax.evaluation.lpips import load_lpips
from r3jax.evaluation.maps import expected_image, expected_renderability, map_of
from r3jax.evaluation.scores import Summary, summarize, worst_rows, write_rows
from r3jax.files import write_atomic
from r3jax.formats.errors import FormatError
from r3jax.frame import Frame
from r3jax.mapping.state import MapState
from r3jax.splatting.config import RasterConfig
from r3jax.splatting.ply import read_scene
from r3jax.splatting.scene import GaussianScene
from r3jax.splatting.views import Views, load_views
from r3jax.trace.errors import RunError
from r3jax.trace.header import package_versions

_PLAIN: dict[str, Any] = {"highlight": False, "markup": False, "soft_wrap": True}
_NETWORKS = {"alex": "AlexNet", "vgg": "VGG16"}


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
        return _frames(self.capture, self.numbers)


@dataclass(frozen=True)
class Outcome:
    """All that is shown and written."""

    training: Training
    test: TestSet
    scene: GaussianScene
    views: Views
    judgment: Judgment
    summaries: tuple[Summary, ...]
    state: MapState | None
    """The map of the training views."""


def run_evaluate(options: Evaluate) -> int:
    """Judges a model and writes rows, summary and contact sheet.

    Raises:
        UserError: no model, no test views, views that cannot be judged, a missing package.
    """
    progress = Console(stderr=True)
    try:
        outcome = _evaluate(options, progress)
        folder = options.out or _default_folder(outcome)
        folder.mkdir(parents=True, exist_ok=True)
        written = _write(options, outcome, folder)
    except (ValueError, OSError, ImportError, RunError, FormatError) as error:
        raise UserError(one_line(error)) from error
    _show(Console(), options, outcome, written)
    return 0


def _evaluate(options: Evaluate, progress: Console) -> Outcome:
    # What can be checked quickly comes first.
    if options.worst < 0:
        raise ValueError(f"--worst must not be negative, got {options.worst}")
    capture = open_capture(options.path, options.up)
    training = _find_training(options, capture)
    test = _choose_views(options, capture, training)
    lpips = None if options.lpips == "none" else load_lpips(options.lpips)
    scene = read_scene(training.model)
    resolution = options.resolution or training.record.get("resolution")
    with progress.status(f"reading {len(test.numbers)} views ..."):
        views = load_views(test.frames(), resolution)
    state, expected = None, None
    if not options.no_renderability and (seen := _seen(training, test, capture)):
        with progress.status(f"mapping {len(seen)} training views ..."):
            state = _map(capture, seen)
            expected = expected_renderability(state, test.frames())
    with _bar(progress) as bar:
        task = bar.add_task("", total=len(views))
        judgment = judge(
            scene,
            views,
            RasterConfig(backend=options.backend),
            background=jnp.asarray(training.background),
            lpips=lpips,
            renderability=expected,
            numbers=test.numbers,
            on_view=lambda done: bar.update(task, completed=done),
        )
    summaries = summarize(judgment.rows, seed=options.seed)
    return Outcome(training, test, scene, views, judgment, summaries, state)


def _find_training(options: Evaluate, capture: Capture) -> Training:
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
        record = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    except ValueError as error:
        raise UserError(f"{path}: the file cannot be read ({one_line(error)})") from error
    is_inside = capture.models.resolve() in model.resolve().parents
    is_same = "data" in record and Path(record["data"]).resolve() == capture.path.resolve()
    return Training(model, record, bool(record) and (is_inside or is_same))


def _choose_views(options: Evaluate, capture: Capture, training: Training) -> TestSet:
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
        title = "all views" if step == 1 else f"views 0, {step}, {2 * step}, ..."
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
    return TestSet(other, numbers, "the views", _overlap(numbers, seen) if is_same else 0)


def _held_out(capture: Capture, training: Training) -> list[int]:
    if not training.is_here:
        why = "there is no train.json beside it" if not training.record else "it is of other data"
        raise UserError(
            f"{training.model}: which views of {capture.path} were held out is not known ({why}); "
            "use --views all, every:N or another run"
        )
    numbers = [int(number) for number in training.record.get("test_views", [])]
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


def _seen(training: Training, test: TestSet, capture: Capture) -> list[int]:
    """Views of the capture for the map: those trained on; none if the capture is other data.

    Without a train.json all views but the tested ones, as a model of them most likely saw them.
    """
    if training.train_views is not None:
        return [number for number in training.train_views if number < len(capture)]
    if training.record:
        return []
    tested = set(test.numbers) if test.capture is capture else set()
    return [number for number in range(len(capture)) if number not in tested]


def _map(capture: Capture, numbers: list[int]) -> MapState:
    config = capture.run.header.config if capture.run is not None else {}
    return map_of(
        _frames(capture, numbers),
        voxel_size=float(config.get("voxel_size", 0.05)),
        max_range=float(config.get("max_range", 5.0)),
    )


def _frames(capture: Capture, numbers: list[int]) -> Iterator[Frame]:
    return (capture.source.frame(number) for number in numbers)


def _bar(console: Console) -> Progress:
    return Progress(
        TextColumn("rendering"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        console=console,
        disable=not console.is_terminal,
        transient=True,
    )


def _default_folder(outcome: Outcome) -> Path:
    run = outcome.test.capture.run
    del run
    raise NotImplementedError
