"""Any setting of any config, tried on a grid: by default the curve of lambda1.

    python -m experiments.sweep --size smoke
    python -m experiments.sweep --vary lambda1=4,8,16,32 --vary map.voxel_size=0.05,0.1
    python -m experiments.sweep --list

Every point is explored, trained and evaluated in scenes for tuning, which are none of those that
the committed tables report: nothing is tuned on the test views of a table. The best point is the
one with the highest mean PSNR over the test views at the end of the budget.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from experiments.pages.artifacts import markdown_table
from experiments.pages.sweep_page import Point, Trial, write_page
from experiments.settings import Setting, Value, find_setting, known_settings, with_settings
from experiments.suite import Options as SuiteOptions
from experiments.suite import origin, request_of, run_cells
from r3jax.apps.benchmark.cells import Cell
from r3jax.apps.benchmark.plan import Request, make_plan
from r3jax.apps.benchmark.record import read_records
from r3jax.simulators.scenes.registry import scene_names

NAME = "sweep"

SizeName = Literal["smoke", "small", "paper"]


@dataclass(frozen=True)
class Options:
    """What is tried, where, and how often."""

    size: SizeName = "smoke"
    """`smoke`: minutes. `small`: an hour or two on two cores. `paper`: for GPUs and clusters."""

    vary: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """`NAME=A,B,C`; given several times, all combinations. By default lambda1, with the values of
    the size."""

    policy: str = "r3-pano"
    """The policies."""

    scenes: tuple[str, ...] = ()
    """Scenes other than the size's."""

    seeds: tuple[int, ...] = ()
    """Seeds of the missions other than the size's; two or more show what chance does."""

    budget: str | None = None
    """Budget other than the size's, such as `views:60`."""

    out: Path = Path("experiments/results")
    """Folder of the page, its table and its figures."""

    work: Path = Path("runs/experiments")
    """Folder of the cells; what is done there is not done again."""

    engine: Literal["local", "slurm"] = "local"
    """Processes on this machine, or an array job."""

    jobs: int = 1
    """Cells at a time; budgets in views are not touched by it."""

    list: bool = False
    """Only list the settings, with their defaults and a sentence each."""


@dataclass(frozen=True)
class _Size:
    scenes: tuple[str, ...]
    seeds: tuple[int, ...]
    budget: str
    values: str
    """Values of lambda1."""


REPORTED = request_of(SuiteOptions(size="small"), "views").scenes
"""Scenes of the committed tables: nothing may be chosen by their test views."""

_SIZES: dict[SizeName, _Size] = {
    "smoke": _Size(("gallery",), (0,), "views:10", "4,16,64"),
    "small": _Size(("apartment", "gallery"), (0, 1), "views:30", "1,4,16,64,256"),
    "paper": _Size(
        tuple(scene for scene in scene_names() if scene not in REPORTED),
        (0, 1, 2),
        "views:300",
        "1,2,4,8,16,32,64,128,256",
    ),
}


def main(options: Options) -> Path | None:
    """Runs what is left of the sweep, writes its results, and returns their folder."""
    if options.list:
        print_settings(options)
        return None
    try:
        settings, points = points_of(options)
        request, root = request_for(options), options.work / f"{options.size}-{NAME}"
        root.mkdir(parents=True, exist_ok=True)
        cells = cells_of(make_plan(request, root), points)
    except ValueError as error:
        raise SystemExit(f"sweep: {error}") from None
    run_cells(in_rounds(cells), root, engine=options.engine, jobs=options.jobs)
    trials = [
        Trial(point, last_records(root, own)) for point, own in zip(points, cells, strict=True)
    ]
    names = "-".join(setting.short for setting in settings)
    folder = options.out / NAME / f"{options.size}-{options.policy}-{names}"
    records = [record for trial in trials for record in trial.records]
    write_page(folder, settings, trials, REPORTED, origin(f"experiments.{NAME}", records))
    print(f"results  {folder}")
    return folder


def print_settings(options: Options) -> None:
    """Every setting that --vary takes."""
    known = known_settings(request_for(options).conditions)
    rows = [
        {"setting": s.name, "default": str(s.default), "what it is": s.sentence}
        for s in known.values()
    ]
    print(markdown_table(rows))


def request_for(options: Options) -> Request:
    """Returns the benchmark without anything varied.

    The conditions of the tables of the same size.
    """
    size = _SIZES[options.size]
    scenes, budget = options.scenes or size.scenes, options.budget or size.budget
    suite = SuiteOptions(size=options.size, scenes=scenes, policies=(options.policy,))
    request = request_of(suite, "views")
    # The model clock: a budget in seconds would otherwise depend on the machine's load.
    conditions = replace(
        request.conditions, budget=budget, snapshots=(budget,), clock="model", lpips="none"
    )
    return replace(request, seeds=options.seeds or size.seeds, conditions=conditions)


def points_of(options: Options) -> tuple[tuple[Setting, ...], tuple[Point, ...]]:
    """Returns the swept settings, and the points to try, that of the defaults among them.

    Raises:
        ValueError: a setting or a value that does not exist.
    """
    words = options.vary or (f"lambda1={_SIZES[options.size].values}",)
    axes = parse_axes(words, known_settings(request_for(options).conditions))
    names = [setting.name for setting in axes]
    points = [dict(zip(names, v, strict=True)) for v in itertools.product(*axes.values())]
    default: Point = {setting.name: setting.default for setting in axes}
    return tuple(axes), tuple(points if default in points else [default, *points])


def parse_axes(
    words: Sequence[str], known: Mapping[str, Setting]
) -> dict[Setting, tuple[Value, ...]]:
    """Returns the values of every swept setting, from `NAME=A,B,C` words.

    Raises:
        ValueError: a word, a name or a value that is not understood, or something given twice.
    """
    axes: dict[Setting, tuple[Value, ...]] = {}
    for word in words:
        name, _, text = word.partition("=")
        if not (name and text):
            raise ValueError(f"--vary takes NAME=VALUES such as lambda1=4,8,16, got {word!r}")
        setting = find_setting(name.strip(), known)
        values = tuple(setting.parse(value.strip()) for value in text.split(","))
        if setting in axes or len(set(values)) < len(values):
            raise ValueError(f"{setting.name} or one of its values is given twice: {word!r}")
        axes[setting] = values
    return axes


def cells_of(plain: tuple[Cell, ...], points: tuple[Point, ...]) -> list[list[Cell]]:
    """Returns the cells of every point: those of the plan under other settings.

    Raises:
        ValueError: a point that cannot work.
    """
    return [[with_settings(cell, point) for cell in plain] for point in points]


def in_rounds(cells: list[list[Cell]]) -> list[Cell]:
    """Returns all points with the first seed, then with the next.

    Cut short, it is a sweep of fewer.
    """
    return sorted((cell for own in cells for cell in own), key=lambda cell: cell.seed)


def last_records(root: Path, cells: list[Cell]) -> list[dict[str, Any]]:
    """Returns the cells' records at the end of the budget."""
    return [r for r in read_records(root, cells) if r["snapshot"] == cells[0].conditions.budget]


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
