"""Does renderability track the error? Views of many models: rank correlations, areas, terms.

    python -m experiments.renderability_vs_error --size smoke

The cells are those of `experiments.replica_dense_views`; for each trained model the map of its
recorded frames is made again, and every term of renderability taken apart.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from experiments.error_analysis import (
    COVER,
    COVERAGE,
    ERRORS,
    SCORE,
    SEEN_ERROR,
    SceneModels,
    correlation_rows,
    scene_models,
    snapshots_of_models,
)
from experiments.error_terms import PRODUCTS, SMALLEST_SHARE, column
from experiments.pages.artifacts import (
    Origin,
    markdown_table,
    write_csv,
    write_figure,
    write_markdown,
)
from experiments.pages.error_figures import (
    TITLES,
    budget_name,
    distribution_figure,
    model_figure,
    scatter_figure,
    term_figure,
    told,
)
from experiments.suite import Options, origin, run_suite
from r3jax.apps.benchmark.record import source_commit
from r3jax.apps.benchmark.tables import notes

NAME = "renderability_vs_error"

_VIEW_COLUMNS = (
    SCORE, COVERAGE, COVER, *(name for name in PRODUCTS if name != SCORE), "psnr", "ssim", "lpips",
    SEEN_ERROR, "seen_share",
)  # fmt: skip
"""What `views.csv` holds of every view."""


def main(options: Options) -> Path:
    """Runs the cells, compares, and returns the folder of the results."""
    root, records = run_suite(options, "views")
    folder = options.out / NAME / options.size
    scenes = list(scene_models(root, records))
    terms = (*notes(records), f"Compared at commit {source_commit() or 'unknown'}.")
    write_page(folder, scenes, terms, origin(f"experiments.{NAME}", records))
    print(f"results  {folder}")
    return folder


def write_page(
    folder: Path, scenes: Sequence[SceneModels], terms: Sequence[str], source: Origin
) -> None:
    """Writes all numbers, the pictures, and the page that shows them scene by scene.

    Args:
        folder: where to.
        scenes: with their models.
        terms: sentences on how the models were made.
        source: command, machine, commit.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_csv(folder / "views.csv", [row for m in scenes for row in view_rows(m)], source)
    numbers = [row for models in scenes for row in correlation_rows(models)]
    write_csv(folder / "correlations.csv", numbers, source)
    methods = ", ".join(dict.fromkeys(method for m in scenes for method in m.methods))
    page = ["# Renderability against the error", _READING]
    page.append(" ".join([_agreement(scenes), f"Models of {methods}.", *terms]))
    for name, figure in (
        ("distributions", distribution_figure(scenes)),
        ("models", model_figure(scenes)),
    ):
        write_figure(folder / f"{name}.png", figure, source)
        page.append(f"![{name}]({name}.png)")
    for models in scenes:
        page.append(f"## {models.scene}")
        for kind, figure in (("scatter", scatter_figure(models)), ("terms", term_figure(models))):
            write_figure(folder / f"{kind}-{models.scene}.png", figure, source)
        page += [
            markdown_table(list(error_rows(models))),
            f"![views]({f'scatter-{models.scene}.png'})",
            "By budget (PSNR of all pixels; last column: of seen pixels, by seen voxels):",
            markdown_table(list(budget_rows(models))),
            "Term by term (Spearman with PSNR):",
            markdown_table(list(term_rows(models))),
            f"![terms]({f'terms-{models.scene}.png'})",
        ]
    write_markdown(folder / f"{NAME}.md", page, source)


_READING = f"""\
Renderability R of a test view is the mean over the pixels of the map's depth buffer (at most
128 x 128) of the R of the voxel that each pixel shows; **a pixel without a voxel counts 0**. The
map holds the recorded frames that the model was trained on, and no others. *Coverage* is the share
of pixels that show a voxel: what is left of R when every voxel is as good as any. *Terms* are
means of the same kind, each of one factor of R (or the product of two) alone; *kappa = 1* leaves
the box test out of all factors. *COVER* is the mean of (1 + cos) / 2 to the nearest seen direction.

**Seen pixels** are those of the test view whose surface some training frame has looked at: the
true point lies within the sensor's range and no more than a voxel behind what the frame measured.
The map has no say in it. PSNR on seen pixels is of these alone (views with less than
{100 * SMALLEST_SHARE:.0f} % of them are left out), and is held against means over the pixels that
show a voxel, so that coverage is in neither: what a term predicts there is its own. *Holes of the
scan left out* is another thing: pixels where the true depth is unknown.

Coefficients are computed within a model (one scene, policy, seed and budget), over its test views,
and averaged over models; scenes are never mixed. LPIPS changes its sign: positive is right. *Given
the other* is Spearman's partial correlation of R given coverage, and of coverage given R. AUSE is
the area between the sparsification curve and the oracle's over that of chance: 0 perfect, 1 chance.
Brackets are 95 % intervals of a bootstrap over test views and over explorations (policy and seed),
drawn independently: the same hard views are hard for all models, and the budgets of one exploration
share frames. So an interval says what other views of the scene and other runs might have given."""


def _agreement(scenes: Sequence[SceneModels]) -> str:
    """Returns whether what was computed here is what the benchmark has recorded."""
    columns = [models.columns for models in scenes]
    score = max(np.nanmax(np.abs(c[SCORE] - c["renderability"])) for c in columns)
    psnr = max(np.nanmax(np.abs(c["psnr"] - c["psnr_again"])) for c in columns)
    return (
        "Computed again from the recorded frames and the stored models, no view's R differs by "
        f"more than {score:.2g} from the benchmark's record, and no PSNR by more than "
        f"{psnr:.2g} dB."
    )


def view_rows(models: SceneModels) -> Iterator[dict[str, Any]]:
    """Yields one row per model and view."""
    names = [name for name in _VIEW_COLUMNS if name in models.columns]
    known = zip(models.methods, models.seeds, models.snapshots, strict=True)
    for m, (method, seed, snapshot) in enumerate(known):
        model = {"scene": models.scene, "method": method, "seed": seed, "snapshot": snapshot}
        for v in range(models.columns[SCORE].shape[1]):
            values = {name: float(models.columns[name][m, v]) for name in names}
            rounded = {k: None if np.isnan(x) else round(x, 4) for k, x in values.items()}
            yield model | {"view": v} | rounded


def error_rows(models: SceneModels) -> Iterator[dict[str, Any]]:
    """Yields R, and coverage beside it, against every error."""
    for error in models.errors():
        for predictor, other in ((SCORE, COVERAGE), (COVERAGE, SCORE)):
            find = lambda statistic, given="", error=error, predictor=predictor: told(
                models.estimate(statistic, predictor, error, given=given)
            )
            yield {
                "error": ERRORS[error],
                "predicted by": TITLES[predictor],
                "Spearman": find("spearman"),
                "Kendall": find("kendall"),
                "AUSE": find("ause"),
                "given the other": find("partial", other),
            }


def budget_rows(models: SceneModels) -> Iterator[dict[str, Any]]:
    """Yields how it goes with the budget."""
    for snapshot in snapshots_of_models(models):
        mine = np.array([name == snapshot for name in models.snapshots])
        mean = lambda name, mine=mine: float(np.nanmean(models.columns[name][mine]))
        find = lambda statistic, predictor, error="psnr", given="", snapshot=snapshot: told(
            models.estimate(statistic, predictor, error, given=given, snapshot=snapshot)
        )
        yield {
            "budget": budget_name(snapshot),
            "models": int(mine.sum()),
            "R": mean(SCORE),
            "coverage": mean(COVERAGE),
            "PSNR [dB]": mean("psnr"),
            "Spearman of R": find("spearman", SCORE),
            "of coverage": find("spearman", COVERAGE),
            "of R given coverage": find("partial", SCORE, given=COVERAGE),
            "of R on seen pixels": find("spearman", SCORE, SEEN_ERROR),
        }


def term_rows(models: SceneModels) -> Iterator[dict[str, Any]]:
    """Yields every term, product and rival: what it says, and how much of that is coverage."""
    for name in (COVERAGE, COVER, *PRODUCTS):
        plain = column(name, "one") if name in PRODUCTS else ""
        find = lambda statistic, predictor, error="psnr", given="": told(
            models.estimate(statistic, predictor, error, given=given)
        )
        given = "" if name == COVERAGE else COVERAGE
        yield {
            "term": TITLES.get(name, name),
            "all pixels": find("spearman", name),
            "kappa = 1": find("spearman", plain) if plain else "",
            "box minus 1": told(models.difference("psnr", name, plain)) if plain else "",
            "with coverage": find("spearman", name, COVERAGE) if given else "",
            "given coverage": find("partial", name, given=given) if given else "",
            "kappa = 1, given coverage": find("partial", plain, given=given) if plain else "",
            "seen pixels": find("spearman", name, SEEN_ERROR),
            "kappa = 1, seen pixels": find("spearman", plain, SEEN_ERROR) if plain else "",
        }


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
