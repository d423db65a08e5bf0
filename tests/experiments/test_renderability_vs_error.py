"""Renderability against the error, from records by hand in which the truth is known."""

import csv
import math

import numpy as np
import pytest
from PIL import Image

from experiments import error_analysis, renderability_vs_error
from experiments.curves import ause
from experiments.error_analysis import COVERAGE, PREDICTORS, from_columns
from experiments.error_terms import PRODUCTS, on_seen
from experiments.pages.artifacts import Origin
from experiments.pages.error_figures import budget_name, told
from experiments.rank_statistics import kendall, partial_spearman, spearman
from r3jax.evaluation.statistics import Estimate
from tests.evaluation.records import record

SOURCE = Origin("python -m experiments.some", "a machine", "abc")
VIEWS = 80
FEW = {"resamples": 60}


def predicted(rng, coverage, quality_on_seen, noise_on_seen):
    """Columns of a model: every term says how good seen voxels are, noise only that they are."""
    seen = {name: quality_on_seen + rng.normal(0, 0.02, VIEWS) for name in PREDICTORS}
    seen["noise"] = seen["noise, kappa=1"] = noise_on_seen
    columns = {name: coverage * values for name, values in seen.items()}
    columns |= {on_seen(name): values for name, values in seen.items()}
    return columns | {COVERAGE: coverage, "seen_share": coverage}


def disguised(scene="flat", seed=0, snapshot=30, policy="r3"):
    """One model: holes are black, and seen pixels are as good as their directions."""
    rng = np.random.default_rng([seed, snapshot, len(scene), len(policy)])
    coverage = rng.uniform(0.3, 1.0, VIEWS)
    quality = rng.uniform(0.2, 0.9, VIEWS)
    noise = 0.97 + rng.normal(0.0, 0.002, VIEWS)  # the same everywhere but for its own noise
    columns = predicted(rng, coverage, quality, noise)
    columns["psnr_seen"] = 10.0 + 20.0 * quality + rng.normal(0, 0.5, VIEWS)
    psnr = columns["psnr_seen"] - 25.0 * (1.0 - coverage)
    columns["psnr_again"] = psnr
    found = record(policy, scene, seed, snapshot, psnr=psnr)
    found["views"]["renderability"] = columns["R"].tolist()
    return found, columns


def models_of(pairs, scene="flat", resamples=60):
    records, columns = zip(*pairs, strict=True)
    return from_columns(scene, list(records), list(columns), resamples=resamples)


@pytest.fixture(scope="module")
def flat():
    return models_of(
        [disguised(seed=seed, snapshot=n) for seed in (0, 1) for n in (30, 60)], resamples=200
    )


def test_coverage_in_disguise_is_exposed(flat):
    """Noise looks like a predictor, and is none: given coverage, or on seen pixels, it is gone."""
    assert flat.estimate("spearman", "noise", "psnr").value > 0.5
    assert flat.estimate("spearman", "noise", COVERAGE).value > 0.98
    given = flat.estimate("partial", "noise", "psnr", given=COVERAGE)
    alone = flat.estimate("spearman", "noise", "psnr_seen")
    for found in (given, alone):
        assert abs(found.value) < 0.15
        assert found.low < 0.0 < found.high
    assert flat.estimate("partial", "bias", "psnr", given=COVERAGE).low > 0.5
    assert flat.estimate("spearman", "bias", "psnr_seen").low > 0.8
    # And the page says so: noise first among the rows that were not asked.
    rows = {row["term"]: row for row in renderability_vs_error.term_rows(flat)}
    assert rows["noise"]["all pixels"] == told(flat.estimate("spearman", "noise", "psnr"))
    assert rows["noise"]["given coverage"] == told(given)
    assert rows["noise"]["seen pixels"] == told(alone)


def test_a_model_alone_gives_the_package_s_statistics():
    pair = disguised()
    one = models_of([pair])
    found, columns = pair
    lpips, psnr = (np.array(found["views"][name]) for name in ("lpips", "psnr"))
    r, coverage = columns["R"], columns[COVERAGE]
    pairs = [
        (one.estimate("spearman", "R", "lpips"), spearman(r, -lpips, **FEW)),
        (one.estimate("kendall", "R", "psnr"), kendall(r, psnr, **FEW)),
        (one.estimate("ause", "R", "lpips"), ause(r, lpips, **FEW)),
        (
            one.estimate("partial", "R", "psnr", given=COVERAGE),
            partial_spearman(r, psnr, [coverage], **FEW),
        ),
        (
            one.estimate("spearman", "bias", "psnr_seen"),
            spearman(columns[on_seen("bias")], columns["psnr_seen"], **FEW),
        ),
        (
            one.estimate("spearman", COVERAGE, "psnr_seen"),
            spearman(coverage, columns["psnr_seen"], **FEW),
        ),
    ]
    for estimate, expected in pairs:
        assert estimate.value == pytest.approx(expected.value, abs=1e-9)
        assert estimate.low <= estimate.value <= estimate.high


def test_models_are_never_pooled():
    """Within both models R falls as PSNR rises; together they would rise (Simpson's paradox)."""
    pairs = []
    for k, snapshot in enumerate((30, 60)):
        found, columns = disguised(snapshot=snapshot)
        order = np.linspace(0.0, 0.1, VIEWS)
        columns["R"] = 0.2 + 0.5 * k + order
        found = record("r3", "flat", 0, snapshot, psnr=15.0 + 10.0 * k - 10.0 * order)
        pairs.append((found, columns))
    both = models_of(pairs)
    assert both.estimate("spearman", "R", "psnr").value == pytest.approx(-1.0)
    pooled = [np.concatenate([p[1]["R"] for p in pairs]), np.ravel(both.columns["psnr"])]
    assert spearman(*pooled, **FEW).value > 0.4


def test_budgets_and_explorations_are_kept_apart(flat):
    assert flat.explorations.tolist() == [0, 0, 1, 1]
    every = [flat.sample("spearman", "R", "psnr")[:, 0]]
    for snapshot, models in (("views:30", [0, 2]), ("views:60", [1, 3])):
        found = flat.estimate("spearman", "R", "psnr", snapshot=snapshot)
        assert found.count == 2
        assert found.value == pytest.approx(np.mean(every[0][models]))
    assert flat.estimate("spearman", "R", "psnr").value == pytest.approx(np.mean(every))
    gap = flat.difference("psnr", "R", "bias")
    assert gap.value == pytest.approx(
        flat.estimate("spearman", "R", "psnr").value
        - flat.estimate("spearman", "bias", "psnr").value
    )


def rows_of(path):
    lines = path.read_text().splitlines()
    assert lines[0] == f"# command: {SOURCE.command}"
    return list(csv.DictReader(line for line in lines if not line.startswith("#")))


@pytest.fixture(scope="module")
def written(flat, tmp_path_factory):
    folder = tmp_path_factory.mktemp("results")
    office = models_of([disguised("office", snapshot=n) for n in (30, 60)], "office")
    renderability_vs_error.write_page(folder, [flat, office], ("Trained briefly.",), SOURCE)
    return folder


@pytest.mark.full
def test_tables_hold_every_scene_and_term(written):
    page = (written / "renderability_vs_error.md").read_text()
    for scene in ("flat", "office"):
        part = page.split(f"## {scene}\n")[1].split("\n## ")[0]
        for term in ("coverage", "COVER", "renderability R", *PRODUCTS):
            assert term == "R" or f"\n| {term} |" in part
        for error in ("PSNR [dB]", "SSIM", "LPIPS", "PSNR on seen pixels [dB]"):
            assert f"\n| {error} | renderability R |" in part
            assert f"\n| {error} | coverage |" in part
        assert "\n| 30 views |" in part
        assert "\n| 60 views |" in part
    found = rows_of(written / "correlations.csv")
    key = lambda row: tuple(row[name] for name in ("scene", "snapshot", "error", "prediction"))
    combinations = {key(row) for row in found}
    assert len(combinations) == 2 * 3 * 5 * len(PREDICTORS)
    assert {row["statistic"] for row in found} == {"spearman", "kendall", "ause", "partial"}
    for row in found:
        if row["value"] and row["low"]:
            assert float(row["low"]) <= float(row["value"]) + 1e-9
    assert len(rows_of(written / "views.csv")) == (4 + 2) * VIEWS


def test_the_page_shows_its_pictures(written):
    page = (written / "renderability_vs_error.md").read_text()
    pictures = sorted(path.name for path in written.glob("*.png"))
    assert pictures == [
        "distributions.png", "models.png", "scatter-flat.png", "scatter-office.png",
        "terms-flat.png", "terms-office.png",
    ]  # fmt: skip
    for name in pictures:
        assert f"({name})" in page
        with Image.open(written / name) as picture:
            assert SOURCE.commit in picture.info["Description"]
            assert min(picture.size) > 200
    assert "differs by more than 0 " in page
    assert "Models of r3. Trained briefly." in page
    assert SOURCE.commit in page


def test_points_and_terms_are_drawn_where_they_belong(flat):
    scatter = renderability_vs_error.scatter_figure(flat)
    panels = scatter.axes
    assert [axes.get_title(loc="left") for axes in panels[:3]] == [
        f"Spearman {told(flat.estimate('spearman', 'R', name))}"
        for name in ("psnr", "ssim", "lpips")
    ]
    for axes, error in zip(panels[:3], ("psnr", "ssim", "lpips"), strict=True):
        drawn = np.concatenate([c.get_offsets() for c in axes.collections])
        expected = np.stack([flat.columns["R"].ravel(), flat.columns[error].ravel()], axis=1)
        np.testing.assert_allclose(np.sort(drawn, axis=0), np.sort(expected, axis=0))
        low, high = axes.get_ylim()
        assert (low > high) == (error == "lpips")
    terms = renderability_vs_error.term_figure(flat)
    found = flat.estimate("partial", "noise", "psnr", given=COVERAGE).value
    place = len(PRODUCTS) - 1 - list(PRODUCTS).index("noise")
    dots = [(line.get_xdata()[0], line.get_ydata()[0]) for line in terms.axes[1].lines[1:]]
    assert any(math.isclose(x, found) and math.isclose(y, place + 0.16) for x, y in dots)


def test_a_benchmark_without_lpips_and_records_that_differ(monkeypatch, tmp_path):
    found, columns = disguised()
    found["views"]["lpips"] = None
    models = models_of([(found, columns)])
    assert "lpips" not in models.errors()
    assert len(renderability_vs_error.scatter_figure(models).axes) == 4
    assert not any(row["error"] == "lpips" for row in error_analysis.correlation_rows(models))
    monkeypatch.setattr(error_analysis, "columns_of", lambda root, record: columns)
    other = disguised(seed=1)[0] | {"clock": "wall"}
    with pytest.raises(ValueError, match="the clock"):
        list(error_analysis.scene_models(tmp_path, [found, other]))
    (one,) = error_analysis.scene_models(tmp_path, [found], resamples=5)
    assert one.scene == "flat"


def test_numbers_as_people_read_them():
    assert told(Estimate(0.5, 0.25, 0.75, 3)) == "0.50 [0.25, 0.75]"
    assert told(Estimate(0.5, np.nan, np.nan, 3)) == "0.50"
    assert told(Estimate(np.nan, np.nan, np.nan, 0)) == "–"
    assert budget_name("views:30") == "30 views"
