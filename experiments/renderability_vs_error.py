"""Does renderability track the error? Rank correlations over the test views of many models.

    python -m experiments.renderability_vs_error --size smoke

The cells are those of `experiments.replica_dense_views`. R of every test view is in their records;
coverage, the share of pixels that show a voxel, is computed from the map of the frames that the
model was trained on. Correlations are computed within a model and averaged over models.

Shape symbols: M models of a scene; V its test views; D draws (`error_statistics`).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import tyro
from matplotlib.figure import Figure

from experiments.error_statistics import (
    Draws,
    draw,
    mean_over_models,
    partial_spearman,
    spearman,
)
from experiments.pages.artifacts import (
    Origin,
    markdown_table,
    write_csv,
    write_figure,
    write_markdown,
)
from experiments.suite import Options, Records, origin, run_suite
from r3jax.apps.benchmark.cells import Conditions
from r3jax.apps.benchmark.policy_style import OKABE_ITO, legend_below
from r3jax.apps.benchmark.reference_images import read_reference_images, reference_path
from r3jax.apps.benchmark.tables import notes
from r3jax.apps.forecast.forecast import view_features
from r3jax.evaluation.comparison import (
    RESAMPLES,
    Estimate,
    check_equal_terms,
    method_name,
    scenes_of,
    view_values,
    with_short_names,
)
from r3jax.evaluation.judge import map_of
from r3jax.plots import style
from r3jax.runs.reader import read_run
from r3jax.scoring.config import ScoringConfig

NAME = "renderability_vs_error"

ERRORS = {"psnr": "PSNR [dB]", "ssim": "SSIM", "lpips": "LPIPS"}
"""Measured errors, by column."""


@dataclass(frozen=True)
class SceneModels:
    """The models of one scene."""

    scene: str

    models: tuple[dict[str, Any], ...]
    """Method, seed and snapshot of each model, [M]."""

    columns: Mapping[str, np.ndarray]
    """`R`, `coverage` and measured errors, [M, V]; NaN where there is none."""

    draws: Draws

    @property
    def explorations(self) -> np.ndarray:
        """Number of each model's exploration (method and seed), [M]."""
        names = [(model["method"], model["seed"]) for model in self.models]
        order = {name: number for number, name in enumerate(dict.fromkeys(names))}
        return np.array([order[name] for name in names])

    def correlations(self, predictor: str, error: str, given: str = "") -> np.ndarray:
        """Returns Spearman's correlation for every model and draw, [M, D].

        LPIPS changes its sign, so that a positive correlation is always a right prediction.

        Args:
            predictor: `R` or `coverage`.
            error: of `ERRORS`.
            given: a prediction that is known already: then the partial correlation.
        """
        sign, weights = (-1.0 if error == "lpips" else 1.0), self.draws.views
        x, y = self.columns[predictor], sign * self.columns[error]
        if not given:
            return np.stack([spearman(a, b, weights) for a, b in zip(x, y, strict=True)])
        parts = zip(x, y, self.columns[given], strict=True)
        return np.stack([partial_spearman(a, b, c, weights) for a, b, c in parts])

    def estimate(self, predictor: str, error: str, given: str = "") -> Estimate:
        """Returns the mean over models of `correlations`, with its interval."""
        found = self.correlations(predictor, error, given)
        return mean_over_models(found, self.explorations, self.draws)


def main(options: Options) -> Path:
    """Runs the cells, compares, and returns the folder of the results."""
    root, records = run_suite(options, "views")
    folder = options.out / NAME / options.size
    check_equal_terms(records, one_snapshot=False)
    coverage = [coverage_of(root, record) for record in records]
    scenes = scene_models(with_short_names(records), coverage)
    write_page(folder, scenes, notes(records), origin(f"experiments.{NAME}", records))
    print(f"results  {folder}")
    return folder


def coverage_of(root: Path, record: Mapping[str, Any]) -> np.ndarray:
    """Returns the share of each test view's pixels that show a voxel of the training frames, [V].

    Raises:
        RunError, FileNotFoundError: the cell's files are not there.
    """
    sensing = record["sensing"]
    run = read_run(root / record["run"])
    frames = [run.frame(step) for step in range(record["exploration"]["views"])]
    conditions = Conditions(
        resolution=record["resolution"],
        fov=sensing["fov"],
        train_resolution=record["training"]["resolution"],
    )
    path = reference_path(root, record["scene_hash"], record["test_views"]["hash"], conditions)
    poses = jnp.asarray(read_reference_images(path).poses, jnp.float32)
    state = map_of(frames, voxel_size=sensing["voxel_size"], max_range=sensing["max_range"])
    return view_features(state, run.camera, poses, ScoringConfig(max_range=sensing["max_range"]))[0]


def scene_models(
    records: Records, coverage: Sequence[np.ndarray], *, resamples: int = RESAMPLES
) -> list[SceneModels]:
    """Returns every scene's models from their records and the coverage of their views."""
    found: list[SceneModels] = []
    for scene in scenes_of(records):
        chosen = [i for i, record in enumerate(records) if record["scene"] == scene]
        columns = {"coverage": np.stack([coverage[i] for i in chosen])}
        for name in ("R", *ERRORS):
            field = "renderability" if name == "R" else name
            values = [view_values(records[i], field) for i in chosen]
            known = [value for value in values if value is not None]
            if len(known) == len(values):
                columns[name] = np.stack(known)
        models = tuple(
            {"method": method_name(r), "seed": r["seed"], "snapshot": r["snapshot"]}
            for r in (records[i] for i in chosen)
        )
        num = len({(model["method"], model["seed"]) for model in models})
        draws = draw(columns["coverage"].shape[1], num, resamples=resamples)
        found.append(SceneModels(scene, models, columns, draws))
    return found


def write_page(
    folder: Path, scenes: Sequence[SceneModels], terms: Sequence[str], source: Origin
) -> None:
    """Writes all views, the picture of the models, and a table for each scene."""
    folder.mkdir(parents=True, exist_ok=True)
    write_csv(folder / "views.csv", [row for m in scenes for row in view_rows(m)], source)
    write_figure(folder / "models.png", model_figure(scenes), source)
    page = ["# Renderability against the error", _READING, " ".join(terms)]
    page.append("![mean R and mean PSNR of every model](models.png)")
    for models in scenes:
        page += [f"## {models.scene}", markdown_table(list(error_rows(models)))]
    write_markdown(folder / f"{NAME}.md", page, source)


_READING = """\
R of a test view is the mean over the pixels of the map's depth buffer of the R of the voxel that
each shows; a pixel without a voxel counts 0. *Coverage* is the share of pixels that show a voxel.
Coefficients are computed within a model (one scene, policy, seed and budget) and averaged over
models. LPIPS changes its sign: positive is right. *Given the other* is Spearman's partial
correlation. Brackets are 95 % intervals of a bootstrap over test views and explorations, drawn
independently."""


def view_rows(models: SceneModels) -> Iterator[dict[str, Any]]:
    """Yields one row per model and view."""
    for m, model in enumerate(models.models):
        for v in range(models.columns["coverage"].shape[1]):
            values = {name: float(column[m, v]) for name, column in models.columns.items()}
            rounded = {k: None if np.isnan(x) else round(x, 4) for k, x in values.items()}
            yield {"scene": models.scene} | model | {"view": v} | rounded


def error_rows(models: SceneModels) -> Iterator[dict[str, Any]]:
    """Yields R, and coverage beside it, against every error."""
    for error in (name for name in ERRORS if name in models.columns):
        for predictor, other in (("R", "coverage"), ("coverage", "R")):
            yield {
                "error": ERRORS[error],
                "predicted by": predictor,
                "Spearman": told(models.estimate(predictor, error)),
                "given the other": told(models.estimate(predictor, error, other)),
            }


def told(found: Estimate) -> str:
    """Returns an estimate with its interval, as tables have it."""
    if np.isnan(found.value):
        return "–"
    if np.isnan(found.low):
        return f"{found.value:.2f}"
    return f"{found.value:.2f} [{found.low:.2f}, {found.high:.2f}]"


def model_figure(scenes: Sequence[SceneModels]) -> Figure:
    """Returns mean R and mean PSNR of every model: a panel per scene, a color per budget."""
    figure = style.new_figure(3.6 * len(scenes), 3.2)
    panels = figure.subplots(1, len(scenes), squeeze=False)[0]
    budgets = list(dict.fromkeys(m["snapshot"] for models in scenes for m in models.models))
    for axes, models in zip(panels, scenes, strict=True):
        style.dress(axes, models.scene, "mean R of the model", "mean PSNR of the model [dB]")
        x, y = (np.nanmean(models.columns[name], axis=1) for name in ("R", "psnr"))
        for budget, color in zip(budgets, OKABE_ITO, strict=False):
            mine = np.array([model["snapshot"] == budget for model in models.models])
            axes.scatter(x[mine], y[mine], s=22, color=color, alpha=0.75, label=budget)
    legend_below(figure, budgets)
    return figure


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
