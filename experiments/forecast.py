"""Is the forecast of the PSNR to be believed? Forecast and truth, scenes left out one at a time.

    python -m experiments.forecast --size small

The views of the trained models are those of `experiments.renderability_vs_error` (its `views.csv`);
the calibration that they give is written beside the page: `r3jax forecast RUN --calibration`, and
the package's own was made so. With `--runs`, the cells of that size are done (if they are not yet),
and the whole forecast is put to the test: views where the grid lets them be, maps and grids after
each budget, and a calibration without the scene, against the benchmark's test views.
"""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from matplotlib.figure import Figure

from experiments.pages.artifacts import (
    joint_origin,
    markdown_table,
    write_csv,
    write_figure,
    write_markdown,
)
from experiments.suite import Options, run_suite
from r3jax.apps.benchmark.record import machine, source_commit
from r3jax.apps.forecast.forecast import forecast_map
from r3jax.apps.forecast.psnr import (
    STATISTICS,
    Calibration,
    errors_of,
    fit,
    leave_one_out,
    statistic,
    write_calibration,
)
from r3jax.evaluation.comparison import method_name, view_values
from r3jax.plots import style
from r3jax.runs.reader import read_run
from r3jax.runs.replay import states_of
from r3jax.runs.settings import config_of

NAME = "forecast"
LEVEL = 0.8
"""Level of the intervals whose coverage is measured."""

Pair = dict[str, tuple[float, float]]
"""Forecast and truth by statistic [dB]."""


@dataclass(frozen=True)
class Ask(Options):
    """The experiment's options."""

    runs: bool = False
    """Forecast from the maps of runs too, made now if they are not there."""


@dataclass(frozen=True)
class Known:
    """The views of trained models, in columns."""

    coverage: np.ndarray
    renderability: np.ndarray
    psnr: np.ndarray
    scenes: list[str]
    models: list[str]

    def without(self, scene: str) -> "Known":
        """Returns all views but those of a scene."""
        keep = np.array([name != scene for name in self.scenes])
        return Known(
            *(column[keep] for column in (self.coverage, self.renderability, self.psnr)),
            [name for name in self.scenes if name != scene],
            [m for m, stays in zip(self.models, keep, strict=True) if stays],
        )

    def pairs(self) -> list[Pair]:
        """Returns the forecast and truth of every model, its scene left out."""
        return leave_one_out(self.coverage, self.renderability, self.psnr, self.scenes, self.models)

    def calibration(self) -> Calibration:
        """Returns the calibration on all these views; the errors are those of `pairs`."""
        count, scenes = len(set(self.models)), sorted(set(self.scenes))
        source = f"{len(self.psnr)} views of {count} models in {', '.join(scenes)}"
        model = fit(self.coverage, self.renderability, self.psnr)
        return Calibration(model, errors_of(self.pairs()), source)

    def scene_of_models(self) -> list[str]:
        """Returns the scene of each model, in the order of `pairs`."""
        return list(dict(zip(self.models, self.scenes, strict=True)).values())


def main(options: Ask) -> Path:
    """Compares, writes the calibration and the page, and returns their folder."""
    folder = options.out / NAME / options.size
    known = read_views(options.out / "renderability_vs_error" / options.size / "views.csv")
    records: Sequence[Mapping[str, Any]] = ()
    root = options.work
    if options.runs:
        root, records = run_suite(options, "views")
    write_page(folder, known, run_rows(root, records, known))
    print(f"results  {folder}")
    return folder


def write_page(folder: Path, known: Known, from_runs: Sequence[dict[str, Any]]) -> None:
    """Writes the calibration, the numbers, the figure and the page.

    Args:
        folder: where to.
        known: the views of the trained models.
        from_runs: rows of `run_rows`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    source = joint_origin(f"experiments.{NAME}", [machine()], [source_commit()])
    write_calibration(folder / "calibration.json", known.calibration())
    scenes, pairs = known.scene_of_models(), known.pairs()
    table = [error_row(name, pairs, scenes, known) for name in STATISTICS]
    write_csv(folder / "errors.csv", table, source)
    write_figure(folder / "forecast.png", truth_figure(pairs, scenes), source)
    parts = [
        "# Forecast and truth of the PSNR of free-space views",
        f"{known.calibration().source}; each model is forecast by a calibration that has not seen "
        f"its scene. The interval is the one of {100 * LEVEL:.0f} %, its width from the errors "
        "among the other scenes; *inside* is the share of the models whose truth it held. *Of a "
        "constant*: the error of guessing that a scene comes out as the others did on average.",
        markdown_table(table),
        "![forecast against truth](forecast.png)",
    ]
    if from_runs:
        write_csv(folder / "runs.csv", list(from_runs), source)
        parts += [
            "## From the maps of runs",
            "Nothing but the map and the grid after the views: the forecast's own views in the "
            "space that may be free, against the test views of the benchmark.",
            markdown_table(list(from_runs)),
        ]
    write_markdown(folder / f"{NAME}.md", parts, source)


def read_views(path: Path) -> Known:
    """Returns the table that `experiments.renderability_vs_error` writes.

    Raises:
        SystemExit: it is not there.
    """
    if not path.exists():
        raise SystemExit(f"{path} is missing: run experiments.renderability_vs_error first")
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    column = lambda name: np.array([float(row[name]) for row in rows])
    models = [" ".join(row[k] for k in ("scene", "method", "seed", "snapshot")) for row in rows]
    return Known(
        column("coverage"), column("R"), column("psnr"), [row["scene"] for row in rows], models
    )


def error_row(
    name: str, pairs: Sequence[Pair], scenes: Sequence[str], known: Known
) -> dict[str, Any]:
    """How far the forecasts of one statistic are off [dB], and how often the interval holds."""
    errors = np.array([pair[name][0] - pair[name][1] for pair in pairs])
    row: dict[str, Any] = {
        "statistic": name,
        "models": len(errors),
        "rms error [dB]": float(np.sqrt(np.mean(errors**2))),
        "of a constant [dB]": _rms_of_constant(name, pairs, scenes),
        "bias [dB]": float(errors.mean()),
    }
    inside = np.zeros(len(errors), dtype=bool)
    for scene in dict.fromkeys(scenes):
        mine = np.array([other == scene for other in scenes])
        row[f"bias in {scene}"] = float(errors[mine].mean())
        inside[mine] = np.abs(errors[mine]) <= _half_width(known.without(scene), name)
    row["half width [dB]"] = known.calibration().half_width(name, LEVEL)
    row["inside"] = f"{100 * inside.mean():.0f} %" if inside.any() else "unknown"
    return row


def _rms_of_constant(name: str, pairs: Sequence[Pair], scenes: Sequence[str]) -> float:
    """Returns the error of the guess that a scene comes out as the others did on average [dB]."""
    truth, scene_of = np.array([pair[name][1] for pair in pairs]), np.array(scenes)
    guesses = np.array([truth[scene_of != scene].mean() for scene in scenes])
    return float(np.sqrt(np.mean((guesses - truth) ** 2)))


def _half_width(others: Known, name: str) -> float:
    """Returns half the width of an interval for a scene, by the errors among the other scenes."""
    if len(set(others.scenes)) < 2:
        return float("nan")
    return float(np.quantile(errors_of(others.pairs())[name], LEVEL))


def run_rows(
    root: Path, records: Sequence[Mapping[str, Any]], known: Known
) -> list[dict[str, Any]]:
    """Returns the forecast from the map alone and truth of every cell at every budget.

    Args:
        root: folder of the benchmark.
        records: of its cells.
        known: what to calibrate with; the scene of a cell is left out.
    """
    rows: list[dict[str, Any]] = []
    for path in dict.fromkeys(record["run"] for record in records):
        run, mine = read_run(root / path), [r for r in records if r["run"] == path]
        others = known.without(mine[0]["scene"]).calibration()
        by_views = {record["exploration"]["views"]: record for record in mine}
        for views, (state, grid) in enumerate(states_of(run), start=1):
            if views not in by_views:
                continue
            reach = config_of(run).max_range
            forecast = forecast_map(state, grid, run.camera, max_range=reach, calibration=others)
            truth = view_values(by_views[views], "psnr")
            assert truth is not None
            row = {
                "scene": mine[0]["scene"],
                "method": method_name(mine[0]),
                "seed": str(mine[0]["seed"]),
                "views": views,
            }
            for name in ("mean", "p10", "p50"):
                row[f"{name} forecast"] = forecast.value(name)
                row[f"{name} truth"] = statistic(np.asarray(truth), name)
            rows.append(row)
    return rows


def truth_figure(pairs: Sequence[Pair], scenes: Sequence[str]) -> Figure:
    """Returns the truth against forecast, a dot for each model, for the mean and p10."""
    figure = style.new_figure(10.0, 4.6)
    for axes, name in zip(figure.subplots(1, 2), ("mean", "p10"), strict=True):
        style.dress(axes, f"{name} of the test views", "forecast [dB]", "truth [dB]")
        for number, scene in enumerate(dict.fromkeys(scenes)):
            points = [p[name] for p, s in zip(pairs, scenes, strict=True) if s == scene]
            axes.scatter(*np.array(points).T, s=18, color=f"C{number}", label=scene, alpha=0.8)
        axes.axline((20.0, 20.0), slope=1.0, color=style.MUTED, linewidth=1)
    figure.axes[0].legend(fontsize=9, frameon=False)
    return figure


if __name__ == "__main__":
    main(tyro.cli(Ask, description=__doc__))
