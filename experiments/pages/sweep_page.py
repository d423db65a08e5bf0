"""The page of a sweep: every point against the default, a figure per setting, and the best point.

The criterion is the mean PSNR over the test views of the tuning scenes, every scene with the same
weight; intervals are those of `r3jax.evaluation.statistics`, over views and seeds.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments.pages.artifacts import (
    Origin,
    markdown_table,
    write_csv,
    write_figure,
    write_markdown,
)
from experiments.pages.benchmark_figures import sweep_figure
from experiments.settings import Setting, Value
from experiments.suite import Records
from r3jax.evaluation.comparison import scenes_of, view_values
from r3jax.evaluation.statistics import Estimate, Scores, mean_over_scenes, paired_difference

Point = dict[str, Value]
"""A value for each swept setting, by its whole name."""


@dataclass(frozen=True)
class Trial:
    """One point, and its results."""

    point: Point
    records: Records
    """Records of one snapshot, at least one."""

    @property
    def scores(self) -> Scores:
        """Per scene the PSNR of its test views, [seeds, views] [dB], seeds ascending."""
        in_order = sorted(self.records, key=lambda record: record["seed"])
        found = {}
        for scene in scenes_of(self.records):
            columns = [view_values(r, "psnr") for r in in_order if r["scene"] == scene]
            found[scene] = np.stack([column for column in columns if column is not None])
        return found


@dataclass(frozen=True)
class Choice:
    """The result of a sweep."""

    best: int
    """The trial with the highest mean; of equals, the first."""

    default: int
    """The trial of the defaults."""

    means: tuple[Estimate, ...]
    """Mean PSNR of every trial [dB]."""

    gains: tuple[Estimate, ...]
    """The same minus that of the default, view by view [dB]."""

    @property
    def chosen(self) -> int:
        """The best, if its gain is more than views and seeds leave open; else the default."""
        return self.best if self.gains[self.best].low > 0.0 else self.default


def choose(trials: Sequence[Trial], default: Point) -> Choice:
    """Compares all trials with that of the default.

    Raises:
        ValueError: the default was not tried, or trials that cannot be compared.
    """
    base = [trial.point for trial in trials].index(default)
    scores = [trial.scores for trial in trials]
    means = tuple(mean_over_scenes(found) for found in scores)
    gains = tuple(paired_difference(found, scores[base]) for found in scores)
    return Choice(int(np.argmax([mean.value for mean in means])), base, means, gains)


def write_page(
    folder: Path,
    settings: Sequence[Setting],
    trials: Sequence[Trial],
    reported: Sequence[str],
    origin: Origin,
) -> None:
    """Writes the table, a figure for each setting, and the page.

    Args:
        folder: where to.
        settings: those that are swept.
        trials: all points, the defaults among them.
        reported: scenes of the committed tables, by which nothing may be chosen.
        origin: command, machine, commit.
    """
    folder.mkdir(parents=True, exist_ok=True)
    choice = choose(trials, {setting.name: setting.default for setting in settings})
    write_csv(folder / "sweep.csv", _rows(settings, trials, choice, "{}"), origin)
    records = trials[0].records
    scenes, seeds = scenes_of(records), sorted({record["seed"] for record in records})
    page = [
        f"# Sweep of {', '.join(setting.name for setting in settings)}",
        f"Mean PSNR over the test views of {', '.join(scenes)} at {records[0]['snapshot']}, seeds "
        f"{', '.join(map(str, seeds))}. In brackets: 95 % bootstrap over views and seeds, not "
        f"corrected for having picked the best of {len(trials)}.",
    ]
    if both := [scene for scene in scenes if scene in reported]:
        page.append(
            f"**{', '.join(both)} is reported by the committed tables: what is chosen here must "
            "not be used for them.**"
        )
    better = choice.chosen != choice.default
    page.append(
        "The interval of the best gain lies above 0: the best is chosen."
        if better
        else "No gain is larger than views and seeds leave open: the default stays."
    )
    for setting in settings:
        name = setting.name.replace(".", "_")
        write_figure(folder / f"{name}.png", setting_figure(setting, trials, choice), origin)
        page.append(f"![PSNR over {setting.name}]({name}.png)")
    page.append(markdown_table(_rows(settings, trials, choice, "{:.4g}")))
    write_markdown(folder / "sweep.md", page, origin)


def setting_figure(setting: Setting, trials: Sequence[Trial], choice: Choice) -> Figure:
    """PSNR over one setting, a line per scene; the others, if any, lie in the band."""
    values = list(dict.fromkeys(_short(trial.point[setting.name]) for trial in trials))
    by_scene: dict[str, list[list[float]]] = {}
    for value in values:
        own = [t for t in trials if _short(t.point[setting.name]) == value]
        for scene in scenes_of(own[0].records):
            means = np.concatenate([trial.scores[scene].mean(axis=1) for trial in own])
            by_scene.setdefault(scene, []).append(means.tolist())
    scores = {scene: _padded(rows) for scene, rows in by_scene.items()}
    chosen = _short(trials[choice.chosen].point[setting.name])
    return sweep_figure(setting.name, values, scores, "mean PSNR of the test views [dB]", chosen)


def _padded(rows: list[list[float]]) -> np.ndarray:
    width = max(map(len, rows))
    return np.array([row + [np.nan] * (width - len(row)) for row in rows])


def _rows(
    settings: Sequence[Setting], trials: Sequence[Trial], choice: Choice, digits: str
) -> list[dict[str, Any]]:
    """A line per point: its values, its mean, its gain, and the mean of each scene."""
    marks = {choice.default: "default"} | {choice.best: "best"}
    if choice.best == choice.default:
        marks = {choice.best: "best, default"}
    rows: list[dict[str, Any]] = []
    for number, trial in enumerate(trials):
        row: dict[str, Any] = {
            s.short: digits.format(v) if isinstance(v := trial.point[s.name], float) else v
            for s in settings
        }
        row["PSNR [dB]"] = _interval(choice.means[number])
        row["minus default [dB]"] = _interval(choice.gains[number], "+")
        row |= {scene: f"{values.mean():.2f}" for scene, values in trial.scores.items()}
        rows.append(row | {"": marks.get(number, "")})
    return rows


def _interval(estimate: Estimate, sign: str = "") -> str:
    return f"{estimate.value:{sign}.2f} [{estimate.low:{sign}.2f}, {estimate.high:{sign}.2f}]"


def _short(value: Value) -> Value:
    """Rounds a number to the digits that a label has."""
    if not isinstance(value, float):
        return value
    rounded = float(f"{value:.4g}")
    return int(rounded) if rounded.is_integer() else rounded
