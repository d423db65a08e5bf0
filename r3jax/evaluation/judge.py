"""Evaluates a model on test views: metrics, the renderability that a map expected, and files."""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from r3jax.errors import InputError
from r3jax.evaluation.evaluate import Evaluation, evaluate
from r3jax.evaluation.image_metrics import load_lpips
from r3jax.evaluation.scores import Summary, summarize, worst_rows, write_rows
from r3jax.files import PNG_MARK, check_replaceable, holds, make_folder, write_atomic
from r3jax.formats.captures import Capture, open_capture
from r3jax.formats.errors import FormatError
from r3jax.frame import Frame
from r3jax.mapping.state import MapState, empty_map
from r3jax.mapping.update import integrate_growing
from r3jax.runs.header import package_versions
from r3jax.scoring.renderability import renderability, renderability_image
from r3jax.splatting.backend import RasterConfig
from r3jax.splatting.model import TrainedModel
from r3jax.splatting.ply import read_scene
from r3jax.splatting.views import Views, load_views
from r3jax.validation.json_text import sealed

OnProgress = Callable[[str, int], None]
"""Receives a stage's name and number of steps, or, without a name, the steps just done."""

NETWORKS = {"alex": "AlexNet", "vgg": "VGG16"}
"""The networks of LPIPS."""


@dataclass(frozen=True)
class TestSet:
    """The test views."""

    capture: Capture
    numbers: list[int]
    """In the capture."""

    title: str
    """As the table calls them."""

    num_trained: int | None
    """Number of them that the model was trained on; None if not known."""

    def frames(self) -> Iterator[Frame]:
        """Iterates over every frame in order, as recorded."""
        return frames_of(self.capture, self.numbers)


def choose_views(
    spec: str, capture: Capture, model: TrainedModel, up: Literal["y", "z"] = "y"
) -> TestSet:
    """Finds the test views of a model.

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
        raise InputError(
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
        raise InputError(f"--views every:N takes a whole number of at least 1, got {spec!r}")
    return int(text)


def _overlap(numbers: list[int], seen: list[int] | None) -> int | None:
    return None if seen is None else len(set(numbers) & set(seen))


def mapped_views(model: TrainedModel, test: TestSet, capture: Capture) -> list[int]:
    """Returns the views of the capture for the map: those that the model was trained on.

    If it was trained on other data, there are none. Without a train.json they are all views but the
    tested ones, as a model of them most likely saw them.
    """
    if model.train_views is not None:
        return [number for number in model.train_views if number < len(capture)]
    if model.record:
        return []
    tested: set[int] = set(test.numbers) if test.capture is capture else set()
    return [number for number in range(len(capture)) if number not in tested]


def frames_of(capture: Capture, numbers: list[int]) -> Iterator[Frame]:
    """Iterates over some frames of a capture, reading one at a time."""
    return (capture.source.frame(number) for number in numbers)


@dataclass(frozen=True)
class JudgeSettings:
    """Settings of the evaluation of a model."""

    lpips: Literal["alex", "vgg", "none"] = "alex"
    """Network of LPIPS; `none` leaves it out."""

    resolution: int | None = None
    """Longer side of the images [px]; None: that of the training."""

    with_map: bool = True
    """Map the training views, and report the renderability of the test views."""

    seed: int = 0
    """Seed of the bootstrap."""

    backend: Literal["auto", "numba", "xla", "splax"] = "auto"
    """Rasterizer."""


@dataclass(frozen=True)
class Judgment:
    """The result of evaluating a model."""

    model: TrainedModel
    test: TestSet
    settings: JudgeSettings
    num_gaussians: int
    views: Views
    evaluation: Evaluation
    summaries: tuple[Summary, ...]

    state: MapState | None
    """The map of the training views; None without one."""

    @property
    def described(self) -> str:
        """Number, source and size of the views."""
        size = f"{self.views.width}x{self.views.height} px"
        return f"{len(self.views)} {self.test.title} of {self.test.capture.path} at {size}"


def judge(
    capture: Capture,
    model: TrainedModel,
    test: TestSet,
    settings: JudgeSettings,
    on_progress: OnProgress,
) -> Judgment:
    """Renders the test views with the model and compares them.

    Args:
        capture: what the model was looked up for: its map is made of it.
        model: the model.
        test: the views that judge.
        settings: how.
        on_progress: progress callback.

    Raises:
        ValueError: a view or the model cannot be read, or views that cannot be compared.
        ImportError: LPIPS is not installed; says how to get it.
    """
    # What can be refused quickly comes first.
    lpips = None if settings.lpips == "none" else load_lpips(settings.lpips)
    scene = read_scene(model.path)
    on_progress(f"reading {len(test.numbers)} views", 0)
    views = load_views(test.frames(), settings.resolution or model.record.get("resolution"))
    state, expected = None, None
    mapped = mapped_views(model, test, capture) if settings.with_map else []
    if mapped:
        on_progress(f"mapping {len(mapped)} training views", 0)
        state = _map(capture, mapped)
        expected = expected_renderability(state, test.frames())
    on_progress("rendering", len(views))
    evaluation = evaluate(
        scene,
        views,
        RasterConfig(backend=settings.backend),
        background=jnp.asarray(model.background),
        lpips=lpips,
        renderability=expected,
        numbers=test.numbers,
        on_view=lambda _: on_progress("", 1),
    )
    summaries = summarize(evaluation.rows, seed=settings.seed)
    return Judgment(model, test, settings, scene.capacity, views, evaluation, summaries, state)


def _map(capture: Capture, numbers: list[int]) -> MapState:
    """Builds the map of some views, with the settings of the run if they are from one."""
    config = capture.run.header.config if capture.run is not None else {}
    return map_of(
        frames_of(capture, numbers),
        voxel_size=float(config.get("voxel_size", 0.05)),
        max_range=float(config.get("max_range", 5.0)),
    )


_MARKS = {
    "json": b'"bootstrap_seed"',
    "csv": b"view,psnr,",
    "parquet": b"renderability",
    "png": PNG_MARK,
}
"""What the files of a judgment hold, by their suffix."""


def check_judgment_folder(folder: Path) -> None:
    """Refuses a folder with files of a judgment's names that are of no judgment.

    Raises:
        NotOursError: names the file.
    """
    if holds(folder / "evaluation.json", _MARKS["json"]):  # earlier versions marked no picture
        return
    for suffix, mark in _MARKS.items():
        check_replaceable(folder / f"evaluation.{suffix}", mark)


def write_judgment(
    judgment: Judgment, folder: Path, spec: str, rows: Literal["csv", "parquet"], worst: int
) -> dict[str, Path]:
    """Writes rows, summary and contact sheet.

    Args:
        judgment: what came out.
        folder: where to.
        spec: the specification of the test views.
        rows: kind of the file with one row per view.
        worst: views on the contact sheet; 0 draws none.

    Returns:
        The files, by what they hold.

    Raises:
        OSError: the disk is full, not writable, ...
        ImportError: no package writes parquet.
    """
    make_folder(folder)
    written = {"rows": folder / f"evaluation.{rows}", "summary": folder / "evaluation.json"}
    write_rows(written["rows"], judgment.evaluation.rows)
    record = _record(judgment, spec)
    if worst:
        written["worst views"] = folder / "evaluation.png"
        # Lazy import: training, which judges nothing, needs no plots.
        from r3jax.plots.style import to_png

        sheet = to_png(_sheet(judgment, worst))
        record["sheet_sha256"] = hashlib.sha256(sheet).hexdigest()
        write_atomic(written["worst views"], sheet)
    text = json.dumps(sealed(record), indent=1, allow_nan=False)
    write_atomic(written["summary"], text.encode())
    return written


def _record(judgment: Judgment, spec: str) -> dict[str, Any]:
    """Collects the numbers, and everything that they depend on."""
    settings = judgment.settings
    summaries: dict[str, Any] = {}
    for summary in judgment.summaries:
        plain = dataclasses.asdict(summary)
        summaries[plain.pop("metric")["name"]] = plain
    return {
        "format": 1,
        "model": str(judgment.model.path),
        "gaussians": judgment.num_gaussians,
        "data": str(judgment.test.capture.path),
        "views": spec,
        "numbers": judgment.test.numbers,
        "trained_on": judgment.test.num_trained,
        "width": judgment.views.width,
        "height": judgment.views.height,
        "lpips": None
        if settings.lpips == "none"
        else {"network": NETWORKS[settings.lpips], "version": "0.1", "input": [-1, 1]},
        "bootstrap_seed": settings.seed,
        "metrics": summaries,
        "packages": package_versions(),
    }


def _sheet(judgment: Judgment, worst: int):
    """Draws the contact sheet of the worst views."""
    from r3jax.evaluation.contact_sheet import SheetView, contact_sheet

    rows, renders = judgment.evaluation.rows, judgment.evaluation.renders
    place = {row.view: i for i, row in enumerate(rows)}
    lines: list[SheetView] = []
    for row in worst_rows(rows, worst):
        i, expected, beyond = place[row.view], None, None
        if judgment.state is not None:
            frame = judgment.test.capture.source.frame(row.view)
            expected = expected_image(judgment.state, frame)
            beyond = np.isinf(np.asarray(frame.depth))
        truth = np.asarray(judgment.views.rgb[i])
        lines.append(SheetView(row, truth, renders[i], expected, beyond))
    psnr = judgment.summaries[0]
    title = (
        f"The worst {len(lines)} of {judgment.described}\n"
        f"mean PSNR {psnr.mean:.2f} dB, median {psnr.median:.2f} dB"
    )
    return contact_sheet(lines, title)


def warnings_of(judgment: Judgment) -> list[str]:
    """Lists warnings about the validity of the numbers."""
    test, warnings = judgment.test, list[str]()
    if test.num_trained:
        warnings.append(
            f"the model was trained on {test.num_trained} of these {len(test.numbers)} views; "
            "the numbers show its fit, not its prediction"
        )
    if test.num_trained is None:
        warnings.append(
            "it is not known whether the model was trained on these views (no train.json beside it)"
        )
    trained = judgment.model.record.get("resolution")
    longer = max(judgment.views.width, judgment.views.height)
    if trained is not None and longer != trained:
        warnings.append(f"the model was trained at {trained} px and is evaluated at {longer} px")
    return warnings


def map_of(
    frames: Iterable[Frame],
    *,
    voxel_size: float = 0.05,
    max_range: float = 5.0,
    num_bins: int = 64,
    drop_edges: bool = True,
) -> MapState:
    """Builds the map of these frames and no others; it grows as needed.

    A run's own map contains the held-out views, too, and would overestimate a model trained without
    them.

    Args:
        frames: those that the model was trained on.
        voxel_size: edge of a voxel [m].
        max_range: depth beyond it is ignored [m].
        num_bins: direction bins per voxel.
        drop_edges: False lets pixels on depth edges in.
    """
    state = empty_map(voxel_size=voxel_size, num_bins=num_bins)
    for frame in frames:
        state = integrate_growing(state, frame, max_range, drop_edges=drop_edges)
    return state


def expected_renderability(state: MapState, frames: Iterable[Frame]) -> list[float]:
    """Computes R of each frame's view, in [0, 1].

    The frames must be as recorded, not made smaller: a voxel's resolution is compared with the
    one at which it was mapped.
    """
    return [float(renderability(state, f.camera, f.T_world_camera)) for f in frames]


def expected_image(state: MapState, frame: Frame) -> np.ndarray:
    """Computes R of the surface at each pixel of a frame's view, [h, w] in [0, 1]."""
    return np.asarray(renderability_image(state, frame.camera, frame.T_world_camera))
