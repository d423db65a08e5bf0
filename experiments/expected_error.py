"""Does the expected error rank views? Fitted on some scenes, tried on one left out at a time.

    python -m experiments.expected_error --cells runs/experiments/small-views \
        --captures kitchen:120:0 library:120:0 --recordings lounge:FOLDER:4:4:136

What is printed as `SQUARED` and `DISSIMILARITY` are the coefficients in
`r3jax.scoring.expected_error`.

Shape symbols: V views of a model; T terms; M models.
"""

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import tyro
from matplotlib.figure import Figure
from scipy.optimize import minimize
from scipy.stats import spearmanr

from experiments.curves import sparsification
from experiments.error_terms import prediction_columns
from experiments.judged_models import (
    FISHER,
    MAX_RANGE,
    SCORES,
    judged_capture,
    judged_cells,
    judged_folds,
    read_judged,
)
from experiments.pages.artifacts import (
    Origin,
    command_line,
    markdown_table,
    write_csv,
    write_figure,
    write_markdown,
)
from r3jax.apps.benchmark.record import machine, source_commit
from r3jax.files import write_atomic
from r3jax.plots import style
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.difficulty import voxel_difficulty
from r3jax.scoring.expected_error import DISSIMILARITY, SQUARED, TERMS, Fit, error_terms

NAME = "expected_error"

EXPECTED = "expected error"
"""The prediction that is put to the test, by a fit that has not seen the scene."""

BASELINES = ("R", "coverage", "bias", "cover", "texture", *FISHER)
"""What it is held against: `cover` is COVER's term; `texture` of the true image and what the
trained model says of itself, `fisherrf` and `d-opt`, are negated."""

_RIDGE = 1e-4
"""Keeps coefficients small that the views say nothing about."""

_LEAST = 1e-5
_NOTHING = 1e-6
_HUBER = 2.0
"""Differences of logarithms beyond this count linearly: a few views are pure hole."""

_RESAMPLES = 2000


@dataclass(frozen=True)
class Options:
    """Which models."""

    cells: tuple[Path, ...] = ()
    """Folders of benchmarks."""

    captures: tuple[str, ...] = ()
    """Scenes captured from random places, as in `kitchen:120:0`: scene, images, seed."""

    recordings: tuple[str, ...] = ()
    """As in `lounge:FOLDER:4:4:136`: name, folder, folds, how many of them, resolution [px]."""

    out: Path = Path("experiments/results")
    """Folder of the results."""

    work: Path = Path("runs/judged_models")
    """Folder of the models; what is there is not made again."""


@dataclass(frozen=True)
class Model:
    """One model's test views."""

    name: str
    scene: str
    kind: str

    terms: np.ndarray
    """Mean of each term of the expected error, [V, T]."""

    columns: dict[str, np.ndarray] = field(default_factory=dict)
    """Baselines and scores, [V] each."""

    @property
    def squared(self) -> np.ndarray:
        """Squared error, [V]."""
        return 10.0 ** (-self.columns["psnr"] / 10.0)

    @property
    def dissimilarity(self) -> np.ndarray:
        """1 - SSIM, [V]."""
        return np.maximum(1.0 - self.columns["ssim"], 1e-3)


Errors = Callable[[Model], np.ndarray]


def main(options: Options) -> Path:
    """Makes what is missing, fits, compares, and returns the folder of the results."""
    models = pooled([model_of(path) for path in paths_of(options)])
    folder = options.out / NAME
    source = Origin(command_line(f"experiments.{NAME}"), machine(), source_commit() or "unknown")
    write_page(folder, models, source)
    print(f"results  {folder}")
    return folder


def paths_of(options: Options) -> Iterable[Path]:
    """Files of all models."""
    for root in options.cells:
        yield from judged_cells(root, options.work)
    for text in options.captures:
        scene, num, seed = text.rsplit(":", 2)
        yield judged_capture(scene, int(num), int(seed), options.work)
    for text in options.recordings:
        scene, source, folds, used, size = text.split(":")
        numbers = int(folds), int(used), int(size)
        yield from judged_folds(Path(source), scene, *numbers, options.work)


def model_of(path: Path) -> Model:
    """A model with the terms and baselines of its views; kept beside it."""
    kept = path.with_suffix(".json")
    if not kept.exists():
        found = read_judged(path)
        config, hard = ScoringConfig(max_range=MAX_RANGE), voxel_difficulty(found.state)
        # One camera for all: the images of a recording have one size, and nearly one lens.
        camera = found.cameras[0]
        means = [
            np.asarray(error_terms(found.state, camera, jnp.asarray(T), config, hard)).mean((1, 2))
            for T in found.poses
        ]
        columns = prediction_columns(found.state, camera, found.poses, config)
        columns = {name: columns[name] for name in BASELINES if name in columns}
        columns |= {name: -values for name, values in found.fisher.items()}
        columns |= {"texture": -found.texture} | found.scores
        plain = {
            "name": found.name,
            "scene": found.scene,
            "kind": found.kind,
            "terms": np.stack(means).tolist(),
            "columns": {name: values.tolist() for name, values in columns.items()},
        }
        write_atomic(kept, json.dumps(plain).encode())
        print(f"views of {found.name}", flush=True)
    plain = json.loads(kept.read_bytes())
    columns = {name: np.array(values) for name, values in plain.pop("columns").items()}
    return Model(**(plain | {"terms": np.array(plain["terms"]), "columns": columns}))


def pooled(models: Sequence[Model]) -> list[Model]:
    """The models, the folds of one recording as one: each of its frames was held out once."""
    found: dict[str, list[Model]] = {}
    for model in models:
        name = model.scene if model.kind == "recording" else model.name
        found.setdefault(name, []).append(model)
    return [
        Model(
            name,
            parts[0].scene,
            parts[0].kind,
            np.concatenate([part.terms for part in parts]),
            {
                key: np.concatenate([part.columns[key] for part in parts])
                for key in parts[0].columns
            },
        )
        for name, parts in found.items()
    ]


def fit_coefficients(models: Sequence[Model], errors: Errors) -> np.ndarray:
    """Nonnegative coefficients whose sums are nearest to the errors, in logarithms; [T].

    Huber's loss, minimized by L-BFGS over their roots. Every scene weighs the same, and in it
    every model.
    """
    design, truth = [m.terms for m in models], [np.log(errors(m) + _LEAST) for m in models]
    scenes = [m.scene for m in models]
    weights = [1.0 / (scenes.count(m.scene) * len(m.terms) * len(set(scenes))) for m in models]
    every = np.concatenate(design)
    scale = every.std(axis=0) + 0.1 * every.mean(axis=0) + 1e-12

    def loss(root: np.ndarray) -> tuple[float, np.ndarray]:
        total, slope = _RIDGE * float(root @ root), 2.0 * _RIDGE * root
        for X, y, weight in zip(design, truth, weights, strict=True):
            sums = X @ (root**2 / scale) + _LEAST
            r = np.log(sums) - y
            size = np.abs(r)
            parts = np.where(size < _HUBER, 0.5 * r * r, _HUBER * (size - 0.5 * _HUBER))
            total += weight * float(parts.sum())
            pull = weight * np.clip(r, -_HUBER, _HUBER) / sums
            slope = slope + (pull @ X) * 2.0 * root / scale
        return total, slope

    start = np.full(every.shape[1], 0.1)
    found = minimize(loss, start, jac=True, method="L-BFGS-B", options={"maxiter": 500})
    return found.x**2 / scale


def expected(model: Model, coefficients: np.ndarray) -> np.ndarray:
    """The error that a fit expects of each view, [V]."""
    return model.terms @ coefficients + _LEAST


def left_out(models: Sequence[Model], errors: Errors) -> list[np.ndarray]:
    """What is expected of each model's views by a fit that has not seen its scene, [V] each."""
    if len({m.scene for m in models}) < 2:
        raise ValueError("one scene is left out at a time: give models of two scenes or more")
    fits = {
        scene: fit_coefficients([m for m in models if m.scene != scene], errors)
        for scene in dict.fromkeys(m.scene for m in models)
    }
    return [expected(m, fits[m.scene]) for m in models]


def package_fit(models: Sequence[Model], errors: Errors, truth: str) -> Fit:
    """The fit on all models; its interval is of the scenes left out."""
    value = (lambda e: -10.0 * np.log10(e)) if truth == "psnr" else (lambda e: 1.0 - e)
    off = [
        m.columns[truth] - value(e) for m, e in zip(models, left_out(models, errors), strict=True)
    ]
    low, high = np.quantile(np.concatenate(off), [0.1, 0.9])
    found = fit_coefficients(models, errors)
    # What the minimizer leaves of a term that does not help is no number to keep.
    coefficients = tuple(float(f"{c:.3g}") if c > _NOTHING else 0.0 for c in found)
    return Fit(coefficients, round(float(low), 3), round(float(high), 3))


def rank(prediction: np.ndarray, quality: np.ndarray) -> float:
    """Spearman's coefficient; 0 where nothing is said."""
    if np.ptp(prediction) == 0.0 or np.ptp(quality) == 0.0:
        return 0.0
    return float(np.asarray(spearmanr(prediction, quality))[0])


def model_rows(models: Sequence[Model]) -> list[dict[str, Any]]:
    """Spearman of every prediction with every score, and AUSE: a row for each model."""
    squared = left_out(models, lambda m: m.squared)
    unlike = left_out(models, lambda m: m.dissimilarity)
    rows = []
    for model, by_psnr, by_ssim in zip(models, squared, unlike, strict=True):
        known = {k: round(float(model.columns[k].mean()), 3) for k in ("coverage", "R", "psnr")}
        row: dict[str, Any] = {"model": model.name, "scene": model.scene, "kind": model.kind}
        row |= {"views": len(model.terms), **known}
        for score in SCORES:
            sign = -1.0 if score == "lpips" else 1.0
            mine = by_psnr if score == "psnr" else by_ssim
            for name in (EXPECTED, *BASELINES):
                prediction = -mine if name == EXPECTED else model.columns[name]
                value = rank(prediction, sign * model.columns[score])
                row[f"{name}, {score}"] = round(value, 3)
        for name in (EXPECTED, *BASELINES):
            prediction = -by_psnr if name == EXPECTED else model.columns[name]
            area = sparsification(prediction, -model.columns["psnr"]).relative
            row[f"{name}, AUSE"] = round(area, 3)
        rows.append(row)
    return rows


def median(rows: Sequence[dict[str, Any]], column: str) -> str:
    """Median over models, with the 95 % interval of a bootstrap over models; none: nothing."""
    if not rows:
        return ""
    values = np.array([row[column] for row in rows])
    drawn = np.random.default_rng(0).integers(0, len(values), (_RESAMPLES, len(values)))
    low, high = np.percentile(np.median(values[drawn], axis=1), [2.5, 97.5])
    return f"{np.median(values):.2f} [{low:.2f}, {high:.2f}]"


def summary_rows(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Medians over the models of each prediction, all and those that are covered well."""
    covered = [row for row in rows if row["coverage"] >= 0.95]
    table = []
    for name in (EXPECTED, *BASELINES):
        line: dict[str, Any] = {"prediction": name}
        line |= {f"with {score}": median(rows, f"{name}, {score}") for score in SCORES}
        for score in ("psnr", "ssim"):
            line[f"{score}, covered well"] = median(covered, f"{name}, {score}")
        line["AUSE"] = median(rows, f"{name}, AUSE")
        table.append(line)
    return table


def scene_rows(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Means over the models of each scene and kind."""
    table = []
    for key in dict.fromkeys((row["scene"], row["kind"]) for row in rows):
        mine = [row for row in rows if (row["scene"], row["kind"]) == key]
        mean = lambda column, mine=mine: float(np.mean([row[column] for row in mine]))
        line: dict[str, Any] = {"scene": key[0], "kind": key[1], "models": len(mine)}
        line["coverage"] = mean("coverage")
        for score in SCORES:
            for name in (EXPECTED, "R", "texture"):
                line[f"{name}, {score}"] = mean(f"{name}, {score}")
        line |= {f"{name}, AUSE": mean(f"{name}, AUSE") for name in (EXPECTED, "R")}
        table.append(line)
    return table


def write_page(folder: Path, models: Sequence[Model], source: Origin) -> None:
    """Writes coefficients, numbers, figure and page."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = model_rows(models)
    fits = {
        "SQUARED": package_fit(models, lambda m: m.squared, "psnr"),
        "DISSIMILARITY": package_fit(models, lambda m: m.dissimilarity, "ssim"),
    }
    for name, fit in fits.items():
        print(f"{name} = Fit({fit.coefficients}, {fit.low}, {fit.high})")
    packaged = {"SQUARED": SQUARED, "DISSIMILARITY": DISSIMILARITY}
    differ = [name for name, fit in fits.items() if fit != packaged[name]]
    record = {name: fit._asdict() for name, fit in fits.items()} | {"terms": TERMS}
    write_atomic(folder / "coefficients.json", (json.dumps(record, indent=1) + "\n").encode())
    write_csv(folder / "models.csv", rows, source)
    write_figure(folder / f"{NAME}.png", rank_figure(rows), source)
    covered = sum(row["coverage"] >= 0.95 for row in rows)
    views = sum(row["views"] for row in rows)
    coefficients = [
        {"term": term} | {name: fit.coefficients[i] for name, fit in fits.items()}
        for i, term in enumerate(TERMS)
    ]
    interval = [
        {"error": name, "one in ten below": fit.low, "one in ten above": fit.high}
        for name, fit in fits.items()
    ]
    page = [
        "# Expected error against the error",
        f"{views} views of {len(rows)} models; the expected error of each model is by a fit that "
        "has not seen its scene. Spearman within each model; *with LPIPS* the sign is changed, and "
        "the fit is that of SSIM. Medians over models, with 95 % intervals of a bootstrap over "
        f"models (those of a scene resemble each other). *Covered well*: the {covered} models "
        "whose test views have a mean coverage of 0.95 or more. *AUSE* is that of PSNR, relative: "
        "0 perfect, 1 chance. *Texture* is the mean gradient of the true image, which no planner "
        "has; *fisherrf* and *d-opt* (POp-GS) ask the trained model how much each view would still "
        "tell it, which takes a model.",
        markdown_table(summary_rows(rows)),
        "Scene by scene, means over models:",
        markdown_table(scene_rows(rows)),
        f"![Spearman of every model]({NAME}.png)",
        "Coefficients of the fit on all scenes"
        + (f" (the package has others of {', '.join(differ)}):" if differ else " (the package's):"),
        markdown_table(coefficients),
        "How far views of scenes left out are from what was expected, [dB] of PSNR and SSIM:",
        markdown_table(interval),
    ]
    write_markdown(folder / f"{NAME}.md", page, source)


def rank_figure(rows: Sequence[dict[str, Any]]) -> Figure:
    """Spearman of the expected error against that of R, a dot for each model."""
    figure = style.new_figure(9.0, 4.4)
    for axes, score in zip(figure.subplots(1, 2), ("psnr", "ssim"), strict=True):
        style.dress(axes, f"Spearman with {score.upper()}", "R", EXPECTED)
        for number, scene in enumerate(dict.fromkeys(row["scene"] for row in rows)):
            mine = [row for row in rows if row["scene"] == scene]
            x, y = ([row[f"{name}, {score}"] for row in mine] for name in ("R", EXPECTED))
            axes.scatter(x, y, s=18, color=f"C{number % 10}", label=scene, alpha=0.8)
        axes.axline((0.0, 0.0), slope=1.0, color=style.MUTED, linewidth=1)
    figure.axes[0].legend(fontsize=8, frameon=False)
    return figure


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
