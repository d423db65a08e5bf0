"""The page of a sweep: the curve, every point, the choice, and what scenes left out say."""

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
from experiments.sweep_choice import Choice, Trial, choose, leave_one_out
from experiments.sweep_space import Point
from r3jax.apps.benchmark.tables import FEWEST_SEEDS
from r3jax.evaluation.comparison import scenes_of
from r3jax.evaluation.statistics import Estimate


@dataclass(frozen=True)
class Sweep:
    """What was tried, and what came of it."""

    policy: str
    settings: tuple[Setting, ...]
    trials: tuple[Trial, ...]

    @property
    def default(self) -> Point:
        """The point of the defaults."""
        return {setting.name: setting.default for setting in self.settings}

    def label(self, point: Point) -> str:
        """Returns a point in words."""
        named = (f"{s.short} = {_text(point[s.name])}" for s in self.settings)
        return ", ".join(named)


def write_page(folder: Path, sweep: Sweep, reported: Sequence[str], origin: Origin) -> None:
    """Writes the table, a figure for each setting, and the page.

    Args:
        folder: where to.
        sweep: its trials hold the defaults.
        reported: scenes of the committed tables, by which nothing may be chosen.
        origin: command, machine, commit.
    """
    folder.mkdir(parents=True, exist_ok=True)
    choice = choose(sweep.trials, sweep.default)
    write_csv(folder / "sweep.csv", csv_rows(sweep, choice), origin)
    page = [_title(sweep), _criterion(sweep, reported), verdict(sweep, choice)]
    for setting in sweep.settings:
        name = setting.name.replace(".", "_")
        write_figure(folder / f"{name}.png", setting_figure(sweep, setting, choice), origin)
        page.append(f"![PSNR over {setting.name}]({name}.png)")
    page.append(markdown_table(point_rows(sweep, choice)))
    page += _left_out(sweep, choice)
    write_markdown(folder / "sweep.md", page, origin)


def setting_figure(sweep: Sweep, setting: Setting, choice: Choice) -> Figure:
    """Returns PSNR over one setting, a line per scene; the others, if any, lie in the band."""
    values = list(dict.fromkeys(_short(trial.point[setting.name]) for trial in sweep.trials))
    by_scene: dict[str, list[list[float]]] = {}
    for value in values:
        own = [t for t in sweep.trials if _short(t.point[setting.name]) == value]
        for scene in scenes_of(own[0].records):
            means = np.concatenate([trial.scores[scene].mean(axis=1) for trial in own])
            by_scene.setdefault(scene, []).append(means.tolist())
    scores = {scene: _padded(rows) for scene, rows in by_scene.items()}
    chosen = _short(sweep.trials[choice.chosen].point[setting.name])
    return sweep_figure(setting.name, values, scores, "mean PSNR of the test views [dB]", chosen)


def _padded(rows: list[list[float]]) -> np.ndarray:
    width = max(map(len, rows))
    return np.array([row + [np.nan] * (width - len(row)) for row in rows])


def point_rows(sweep: Sweep, choice: Choice) -> list[dict[str, Any]]:
    """Returns a line per point, as people read it."""
    rows = []
    for i, trial in enumerate(sweep.trials):
        marks = [word for word, j in (("best", choice.best), ("default", choice.default)) if i == j]
        row: dict[str, Any] = {s.short: _text(trial.point[s.name]) for s in sweep.settings}
        row["PSNR [dB]"] = _interval(choice.means[i])
        row["minus default [dB]"] = "" if i == choice.default else _interval(choice.gains[i], "+")
        scores = trial.scores
        for scene, values in scores.items():
            row[scene] = f"{values.mean():.2f}"
        row["5th percentile"] = f"{_tail(list(scores.values())):.2f}"
        row["known share"] = f"{_explored(trial):.2f}"
        rows.append(row | {"": ", ".join(marks)})
    return rows


def csv_rows(sweep: Sweep, choice: Choice) -> list[dict[str, Any]]:
    """Returns a line per point, scene and seed, with every digit.

    The point's own numbers beside them.
    """
    rows = []
    for trial, mean, gain in zip(sweep.trials, choice.means, choice.gains, strict=True):
        of_point = {
            "psnr_of_point": mean.value, "low": mean.low, "high": mean.high,
            "minus_default": gain.value, "gain_low": gain.low, "gain_high": gain.high,
        }  # fmt: skip
        for record in sorted(trial.records, key=lambda r: (r["scene"], r["seed"])):
            rows.append(
                trial.point
                | {name: record[name] for name in ("scene", "seed", "snapshot")}
                | {"psnr": float(np.nanmean(np.array(record["views"]["psnr"], float)))}
                | {k: record["exploration"][k] for k in ("views", "metres", "known_share")}
                | of_point
            )
    return rows


def verdict(sweep: Sweep, choice: Choice) -> str:
    """Returns the choice in words, and how far it can be trusted."""
    best, default = (sweep.trials[i].point for i in (choice.best, choice.default))
    words = [f"Best is **{sweep.label(best)}**: {_interval(choice.means[choice.best])} dB."]
    if choice.best == choice.default:
        words.append("That is the default.")
    else:
        gain = _interval(choice.gains[choice.best], "+")
        words += [
            f"The default, {sweep.label(default)}, has {_interval(choice.means[choice.default])} "
            f"dB; the difference, view by view, is {gain} dB.",
            "The interval lies above 0: the best is chosen."
            if choice.is_better
            else "The interval holds 0: these views and seeds do not tell them apart, and the "
            "default stays.",
        ]
    ends = [s.short for s in sweep.settings if _is_at_an_end(sweep, s, best[s.name])]
    if ends:
        words.append(f"The best {', '.join(ends)} lies at an end of what was tried.")
    seeds = {record["seed"] for record in sweep.trials[0].records}
    if len(seeds) < FEWEST_SEEDS:
        words.append(f"With {len(seeds)} of {FEWEST_SEEDS} seeds the intervals are too narrow.")
    words.append(
        f"Of {len(sweep.trials)} points the best is flattered by having been picked; no interval "
        "here corrects for that."
    )
    return " ".join(words)


def _is_at_an_end(sweep: Sweep, setting: Setting, value: Value) -> bool:
    tried = [trial.point[setting.name] for trial in sweep.trials]
    if setting.kind not in (int, float) or None in tried:
        return False
    return value in (min(tried), max(tried))  # pyright: ignore[reportArgumentType]


def _title(sweep: Sweep) -> str:
    return f"# Sweep of {', '.join(s.name for s in sweep.settings)} for {sweep.policy}"


def _criterion(sweep: Sweep, reported: Sequence[str]) -> str:
    records = sweep.trials[0].records
    scenes, seeds = scenes_of(records), sorted({record["seed"] for record in records})
    text = (
        f"The criterion is the mean PSNR over the test views of {', '.join(scenes)} at "
        f"{records[0]['snapshot']}, every scene with the same weight; seeds "
        f"{', '.join(map(str, seeds))}. In brackets: 95 % bootstrap over views and seeds. "
    )
    both = [scene for scene in scenes if scene in reported]
    if both:
        return text + (
            f"**{', '.join(both)} is reported by the committed tables: what is chosen here must "
            "not be used for them.**"
        )
    return text + (
        f"The committed tables report other scenes ({', '.join(map(_scene_name, reported))}), so "
        "that nothing is tuned on the test views of a table."
    )


def _scene_name(scene: str) -> str:
    return Path(scene.removeprefix("mesh:")).stem


def _left_out(sweep: Sweep, choice: Choice) -> list[str]:
    rows = [
        {
            "scene": row.scene,
            "chosen by the others": sweep.label(sweep.trials[row.best].point),
            "gain here over the default [dB]": _interval(row.gain, "+"),
        }
        for row in leave_one_out(sweep.trials, choice.default)
    ]
    if not rows:
        return []
    text = "What the other scenes choose, evaluated by the scene that had no say in it:"
    return [text, markdown_table(rows)]


def _tail(scores: Sequence[np.ndarray]) -> float:
    """Returns the mean over scenes of the 5th percentile of the views."""
    return float(np.mean([np.nanpercentile(values, 5) for values in scores]))


def _explored(trial: Trial) -> float:
    return float(np.mean([record["exploration"]["known_share"] for record in trial.records]))


def _interval(estimate: Estimate, sign: str = "") -> str:
    return f"{estimate.value:{sign}.2f} [{estimate.low:{sign}.2f}, {estimate.high:{sign}.2f}]"


def _short(value: Value) -> Value:
    """Formats a number without superfluous digits."""
    if not isinstance(value, float):
        return value
    rounded = float(f"{value:.4g}")
    return int(rounded) if rounded.is_integer() else rounded


def _text(value: Value) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
