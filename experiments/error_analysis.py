"""All models of a scene side by side: what was predicted of each view, and what came out.

Shape symbols: M models of a scene; V its test views; D draws (`error_statistics`).
"""

import functools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from experiments import error_statistics
from experiments.error_statistics import Draws, draw, mean_over_models
from experiments.error_terms import KAPPAS, PRODUCTS, column, columns_of, on_seen
from experiments.suite import Records
from r3jax.evaluation.comparison import (
    check_equal_terms,
    method_name,
    scenes_of,
    snapshots_of,
    view_values,
    with_short_names,
)
from r3jax.evaluation.statistics import RESAMPLES, Estimate

COVERAGE, COVER, SCORE = "coverage", "cover", "R"
"""Predictions that have a part of their own."""

SEEN_ERROR = "psnr_seen"
"""The error that is measured on seen pixels, and predicted from seen voxels."""

ERRORS = {
    "psnr": "PSNR [dB]",
    "ssim": "SSIM",
    "lpips": "LPIPS",
    "psnr_measured": "PSNR, holes of the scan left out [dB]",
    SEEN_ERROR: "PSNR on seen pixels [dB]",
}
"""What came out, by column."""

PREDICTORS = (
    COVERAGE,
    COVER,
    *(column(product, kappa) for product in PRODUCTS for kappa in KAPPAS),
)
"""What is held against it."""

PER_MODEL: dict[str, Callable[..., np.ndarray]] = {
    "spearman": error_statistics.spearman,
    "kendall": error_statistics.kendall,
    "partial": error_statistics.partial_spearman,
    "ause": lambda x, y, weights: error_statistics.ause(x, -y, weights),
}
"""Statistics of a prediction, a quality (higher is better), what is given, and draws' weights."""


@dataclass(frozen=True)
class SceneModels:
    """The models of one scene."""

    scene: str

    methods: tuple[str, ...]
    """Who chose the views, [M]."""

    seeds: tuple[int, ...]
    """Seed of each model, [M]."""

    snapshots: tuple[str, ...]
    """Budget of each model, [M]."""

    columns: Mapping[str, np.ndarray]
    """Predictions and errors by name, [M, V]; NaN where there is none."""

    explorations: np.ndarray
    """Number of each model's exploration (method and seed), [M]."""

    draws: Draws

    _samples: dict[tuple[str, ...], np.ndarray] = field(default_factory=dict, repr=False)

    def errors(self) -> list[str]:
        """Returns the errors that were measured."""
        return [name for name in ERRORS if name in self.columns]

    def estimate(
        self, statistic: str, predictor: str, error: str, *, given: str = "", snapshot: str = ""
    ) -> Estimate:
        """Returns the mean over models of a statistic of their views.

        On seen pixels a prediction is its mean over seen voxels. LPIPS changes its sign, so that
        a positive correlation is always a right prediction.

        Args:
            statistic: of `PER_MODEL`.
            predictor: of `PREDICTORS`.
            error: of `ERRORS`, or a prediction.
            given: prediction that is known already, for `partial`.
            snapshot: whose models; all by default.
        """
        samples = self.sample(statistic, predictor, error, given)
        of_snapshot = np.array([snapshot in ("", name) for name in self.snapshots])
        return mean_over_models(samples, self.explorations, self.draws, models=of_snapshot)

    def difference(self, error: str, first: str, second: str) -> Estimate:
        """Returns the Spearman correlation of the first prediction minus the second's, by model."""
        one, other = (self.sample("spearman", name, error) for name in (first, second))
        return mean_over_models(one - other, self.explorations, self.draws)

    def prediction(self, predictor: str, error: str) -> np.ndarray:
        """Returns the column that is held against an error, [M, V]."""
        name = on_seen(predictor) if error == SEEN_ERROR and predictor != COVERAGE else predictor
        return self.columns[name]

    def sample(self, statistic: str, predictor: str, error: str, given: str = "") -> np.ndarray:
        """Returns the statistic of every model and draw, [M, D]; arguments as in `estimate`."""
        key = (statistic, predictor, error, given)
        if key not in self._samples:
            self._samples[key] = self._sample(*key)
        return self._samples[key]

    def _sample(self, statistic: str, predictor: str, error: str, given: str) -> np.ndarray:
        quality = self.columns[error] * (-1.0 if error == "lpips" else 1.0)
        parts = [self.prediction(predictor, error), quality]
        parts += [self.columns[given]] if given else []
        compute = functools.partial(PER_MODEL[statistic], weights=self.draws.views)
        return np.stack([compute(*views) for views in zip(*parts, strict=True)])


def scene_models(
    root: Path, records: Records, *, resamples: int = RESAMPLES
) -> Iterator[SceneModels]:
    """Yields every scene's models, with all that is known of their views.

    Args:
        root: folder of the benchmark.
        records: of its cells, on equal terms.
        resamples: of the intervals.

    Raises:
        ValueError: records that cannot stand side by side.
    """
    check_equal_terms(records, one_snapshot=False)
    found = with_short_names(records)
    paths = [columns_of(root, record) for record in records]
    for scene in scenes_of(found):
        chosen = [i for i, record in enumerate(found) if record["scene"] == scene]
        yield from_columns(
            scene, [found[i] for i in chosen], [paths[i] for i in chosen], resamples=resamples
        )


def from_columns(
    scene: str,
    records: list[Any],
    predicted: list[dict[str, np.ndarray]],
    *,
    resamples: int = RESAMPLES,
) -> SceneModels:
    """The models of a scene from their records and what `error_terms.columns_of` gives of each."""
    columns = {name: np.stack([each[name] for each in predicted]) for name in predicted[0]}
    for name in (*ERRORS, "renderability"):
        values = [view_values(record, name) for record in records]
        known = [value for value in values if value is not None]
        if len(known) == len(values):
            columns[name] = np.stack(known)
    names = [f"{method_name(record)}, seed {record['seed']}" for record in records]
    order = {name: number for number, name in enumerate(dict.fromkeys(names))}
    num_views = columns[COVERAGE].shape[1]
    return SceneModels(
        scene=scene,
        methods=tuple(method_name(record) for record in records),
        seeds=tuple(record["seed"] for record in records),
        snapshots=tuple(record["snapshot"] for record in records),
        columns=columns,
        explorations=np.array([order[name] for name in names]),
        draws=draw(num_views, len(order), resamples=resamples),
    )


def snapshots_of_models(models: SceneModels) -> list[str]:
    """Returns the budgets, smallest first."""
    return snapshots_of([{"snapshot": name} for name in models.snapshots])


def correlation_rows(models: SceneModels) -> Iterator[dict[str, Any]]:
    """Yields every number of a scene with its interval.

    A line for each, for tables of one's own.
    """
    for snapshot in ("", *snapshots_of_models(models)):
        for error in models.errors():
            for predictor in PREDICTORS:
                for statistic, given in _statistics(predictor):
                    found = models.estimate(
                        statistic, predictor, error, given=given, snapshot=snapshot
                    )
                    yield {
                        "scene": models.scene,
                        "snapshot": snapshot or "all",
                        "error": error,
                        "prediction": predictor,
                        "statistic": statistic,
                        "given": given,
                        "value": _rounded(found.value),
                        "low": _rounded(found.low),
                        "high": _rounded(found.high),
                        "models": found.count,
                    }


def _statistics(predictor: str) -> list[tuple[str, str]]:
    """Returns names of statistics and what is given: all of them for R and coverage."""
    if predictor == SCORE:
        return [("spearman", ""), ("kendall", ""), ("ause", ""), ("partial", COVERAGE)]
    if predictor == COVERAGE:
        return [("spearman", ""), ("kendall", ""), ("ause", ""), ("partial", SCORE)]
    return [("spearman", ""), ("partial", COVERAGE)]


def _rounded(value: float) -> float | None:
    return None if np.isnan(value) else round(value, 4)
