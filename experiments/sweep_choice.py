"""Which of the points of a sweep is the best, how sure that is, and would others agree.

The criterion is the mean PSNR over the test views of the tuning scenes, every scene with the same
weight; intervals are those of `r3jax.evaluation.statistics`, over views and seeds.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from experiments.suite import Records
from experiments.sweep_space import Point
from r3jax.evaluation.comparison import scenes_of, view_values
from r3jax.evaluation.statistics import Estimate, Scores, mean_over_scenes, paired_difference

METRIC = "psnr"


@dataclass(frozen=True)
class Trial:
    """One point, and what came of it."""

    point: Point
    records: Records
    """Records of one snapshot, at least one."""

    @property
    def scores(self) -> Scores:
        """Per scene the PSNR of its test views, [seeds, views] [dB], seeds ascending."""
        in_order = sorted(self.records, key=lambda record: record["seed"])
        found = {}
        for scene in scenes_of(self.records):
            columns = [view_values(r, METRIC) for r in in_order if r["scene"] == scene]
            found[scene] = np.stack([column for column in columns if column is not None])
        return found


@dataclass(frozen=True)
class Choice:
    """What the sweep says."""

    best: int
    """The trial with the highest mean."""

    default: int
    """The trial of the defaults."""

    means: tuple[Estimate, ...]
    """Mean PSNR of every trial [dB]."""

    gains: tuple[Estimate, ...]
    """The same minus that of the default, view by view [dB]."""

    @property
    def is_better(self) -> bool:
        """Whether the best beats the default by more than views and seeds leave open."""
        return self.best != self.default and self.gains[self.best].low > 0.0

    @property
    def chosen(self) -> int:
        """The trial to use from now on: without evidence for another one, the default stays."""
        return self.best if self.is_better else self.default


def choose(trials: Sequence[Trial], default: Point) -> Choice:
    """Returns the arg max of the criterion; of equals, the first.

    Args:
        trials: the same scenes, seeds and views in all of them.
        default: the point that the others are compared with; one of the trials.

    Raises:
        ValueError: the default was not tried, or trials that cannot be compared.
    """
    points = [trial.point for trial in trials]
    if default not in points:
        raise ValueError(f"the default {default} was not tried")
    base = points.index(default)
    scores = [trial.scores for trial in trials]
    means = tuple(mean_over_scenes(found) for found in scores)
    gains = tuple(paired_difference(found, scores[base]) for found in scores)
    best = int(np.argmax([mean.value for mean in means]))
    return Choice(best, base, means, gains)


@dataclass(frozen=True)
class LeftOut:
    """One scene, evaluated by what all others chose."""

    scene: str
    best: int
    """The trial that is best in the other scenes."""

    gain: Estimate
    """What it gains in this scene over the default [dB]."""


def leave_one_out(trials: Sequence[Trial], default: int) -> tuple[LeftOut, ...]:
    """Returns the for every scene, the choice of the other scenes and what it achieves here.

    Nothing here was chosen by the views that evaluate it: this is how much tuning really gains.
    Empty with a single scene.
    """
    scores = [trial.scores for trial in trials]
    scenes = sorted(scores[0])
    if len(scenes) < 2:
        return ()
    # Means over seeds and views, [trials, scenes].
    table = np.array([[np.nanmean(found[scene]) for scene in scenes] for found in scores])
    rows = []
    for i, scene in enumerate(scenes):
        best = int(np.argmax(np.delete(table, i, axis=1).mean(axis=1)))
        here, base = ({scene: scores[j][scene]} for j in (best, default))
        rows.append(LeftOut(scene, best, paired_difference(here, base)))
    return tuple(rows)
