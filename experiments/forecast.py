"""Is the forecast of the PSNR to be believed? Forecast and truth, scenes left out one at a time.

    python -m experiments.forecast --size small

The views of the trained models are those of `experiments.renderability_vs_error` (its `views.csv`);
the calibration that they give is written beside the page: `r3jax forecast RUN --calibration`, and
the package's own was made so.
"""

import csv
from collections.abc import Sequence
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
from experiments.suite import Options
from r3jax.apps.benchmark.record import machine, source_commit
from r3jax.apps.forecast.psnr import (
    STATISTICS,
    Calibration,
    errors_of,
    fit,
    leave_one_out,
    write_calibration,
)
from r3jax.plots import style

NAME = "forecast"
LEVEL = 0.8
"""Level of the intervals whose coverage is measured."""

Pair = dict[str, tuple[float, float]]
"""Forecast and truth by statistic [dB]."""


@dataclass(frozen=True)
class Known:
    """The views of trained models, in columns."""

    coverage: np.ndarray
    renderability: np.ndarray
    psnr: np.ndarray
    scenes: list[str]
    models: list[str]

    def without(self, scene: str) -> "Known":
        """All views but those of a scene."""
        keep = np.array([name != scene for name in self.scenes])
        return Known(
            *(column[keep] for column in (self.coverage, self.renderability, self.psnr)),
            [name for name in self.scenes if name != scene],
            [m for m, stays in zip(self.models, keep, strict=True) if stays],
        )

    def pairs(self) -> list[Pair]:
        """Forecast and truth of every model, its scene left out."""
        return leave_one_out(self.coverage, self.renderability, self.psnr, self.scenes, self.models)

    def calibration(self) -> Calibration:
        """Calibration on all these views; the errors are those of `pairs`."""
        count, scenes = len(set(self.models)), sorted(set(self.scenes))
        source = f"{len(self.psnr)} views of {count} models in {', '.join(scenes)}"
        model = fit(self.coverage, self.renderability, self.psnr)
        return Calibration(model, errors_of(self.pairs()), source)

    def scene_of_models(self) -> list[str]:
        """Scene of each model, in the order of `pairs`."""
        return list(dict(zip(self.models, self.scenes, strict=True)).values())


def main(options: Options) -> Path:
    """Compares, writes the calibration and the page, and returns their folder."""
    folder = options.out / NAME / options.size
    known = read_views(options.out / "renderability_vs_error" / options.size / "views.csv")
    write_page(folder, known)
    print(f"results  {folder}")
    return folder


def write_page(folder: Path, known: Known) -> None:
    """Writes the calibration, the numbers, the figure and the page.

    Args:
        folder: where to.
        known: the views of the trained models.
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
    write_markdown(folder / f"{NAME}.md", parts, source)


def read_views(path: Path) -> Known:
    """The table that `experiments.renderability_vs_error` writes.

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
    """Error of the guess that a scene comes out as the others did on average [dB]."""
    truth, scene_of = np.array([pair[name][1] for pair in pairs]), np.array(scenes)
    guesses = np.array([truth[scene_of != scene].mean() for scene in scenes])
    return float(np.sqrt(np.mean((guesses - truth) ** 2)))


def _half_width(others: Known, name: str) -> float:
    """Half the width of an interval for a scene, by the errors among the other scenes."""
    if len(set(others.scenes)) < 2:
        return float("nan")
    return float(np.quantile(errors_of(others.pairs())[name], LEVEL))


def truth_figure(pairs: Sequence[Pair], scenes: Sequence[str]) -> Figure:
    """Truth against forecast, a dot for each model, for the mean and p10."""
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
    main(tyro.cli(Options, description=__doc__))
