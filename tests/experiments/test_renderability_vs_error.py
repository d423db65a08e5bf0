"""Renderability against the error, from records by hand in which the truth is known."""

import csv

import numpy as np
import pytest

from experiments import renderability_vs_error as experiment
from experiments.pages.artifacts import Origin
from experiments.renderability_vs_error import scene_models
from tests.evaluation.records import record

SOURCE = Origin("python -m experiments.some", "a machine", "abc")
VIEWS = 80


def disguised(scene="flat", seed=0, snapshot=30, knows=True):
    """One model: holes are black, and seen pixels are as good as R says, if it knows anything."""
    rng = np.random.default_rng([seed, snapshot, len(scene)])
    coverage, quality = rng.uniform(0.3, 1.0, VIEWS), rng.uniform(0.2, 0.9, VIEWS)
    psnr = 10.0 + 20.0 * quality - 25.0 * (1.0 - coverage) + rng.normal(0, 0.5, VIEWS)
    found = record("r3", scene, seed, snapshot, psnr=psnr)
    noise = 0.97 + rng.normal(0.0, 0.002, VIEWS)
    found["views"]["renderability"] = (coverage * (quality if knows else noise)).tolist()
    return found, coverage


def models_of(pairs, resamples=200):
    records, coverage = zip(*pairs, strict=True)
    return scene_models(records, coverage, resamples=resamples)


def test_coverage_in_disguise_is_exposed():
    """A score that is coverage with noise looks like a predictor; given coverage it is gone."""
    runs = [(seed, n) for seed in (0, 1) for n in (30, 60)]
    (blind,) = models_of([disguised(seed=s, snapshot=n, knows=False) for s, n in runs])
    assert blind.estimate("R", "psnr").low > 0.5
    given = blind.estimate("R", "psnr", "coverage")
    assert given.low < 0.0 < given.high
    (sighted,) = models_of([disguised(seed=s, snapshot=n) for s, n in runs])
    assert sighted.estimate("R", "psnr", "coverage").low > 0.5
    assert sighted.explorations.tolist() == [0, 0, 1, 1]
    assert sighted.estimate("R", "psnr").count == 4


def test_models_are_never_pooled():
    """Within both models R falls as PSNR rises; together they would rise (Simpson's paradox)."""
    pairs = []
    for k, snapshot in enumerate((30, 60)):
        order = np.linspace(0.0, 0.1, VIEWS)
        found = record("r3", "flat", 0, snapshot, psnr=15.0 + 10.0 * k - 10.0 * order)
        found["views"]["renderability"] = (0.2 + 0.5 * k + order).tolist()
        pairs.append((found, np.ones(VIEWS)))
    (both,) = models_of(pairs)
    assert both.estimate("R", "psnr").value == pytest.approx(-1.0)


def test_page_and_views_hold_every_scene(tmp_path):
    pairs = [disguised(scene, snapshot=n) for scene in ("flat", "office") for n in (30, 60)]
    for found, _ in pairs:
        found["views"]["lpips"] = None  # a benchmark without it
    scenes = models_of(pairs)
    experiment.write_page(tmp_path, scenes, ("Trained briefly.",), SOURCE)
    page = (tmp_path / "renderability_vs_error.md").read_text()
    assert SOURCE.commit in page
    for models in scenes:
        part = page.split(f"## {models.scene}\n")[1].split("\n## ")[0]
        rows = [line.split(" | ")[:2] for line in part.splitlines() if line.startswith("| ")][2:]
        assert len(rows) == 4  # R and coverage against PSNR and SSIM
        assert experiment.told(models.estimate("R", "psnr")) in part
    lines = (tmp_path / "views.csv").read_text().splitlines()
    found = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    assert len(found) == 4 * VIEWS
    assert float(found[0]["coverage"]) == pytest.approx(pairs[0][1][0], abs=1e-4)
    assert (tmp_path / "models.png").exists()
