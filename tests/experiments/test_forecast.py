"""The table of forecast and truth: by hand, and from a table of views that is written here."""

import numpy as np
import pytest

from experiments import forecast as experiment
from experiments.forecast import Known, error_row, read_views, write_page
from r3jax.apps.forecast.psnr import STATISTICS, read_calibration


def known_views(offsets=(0.0, 0.5, -0.5)) -> Known:
    """Three scenes of four models each, 60 views a model, whose PSNR follows one law."""
    rng = np.random.default_rng(0)
    parts, scenes, models = [], [], []
    for number, offset in enumerate(offsets):
        for model in range(4):
            coverage = rng.beta(2.0, 1.0, 60)
            value = coverage * rng.random(60)
            psnr = 6.0 + offset + 16.0 * coverage + 6.0 * value + rng.standard_normal(60)
            parts.append((coverage, value, psnr))
            scenes += [f"scene{number}"] * 60
            models += [f"scene{number} model{model}"] * 60
    return Known(*(np.concatenate(c) for c in zip(*parts, strict=True)), scenes, models)


@pytest.fixture(scope="module")
def known():
    return known_views()


def test_an_interval_knows_nothing_of_its_own_scene(known):
    """Half widths come from the errors among the other scenes: a wild one widens not its own."""
    wild = known_views((0.0, 0.0, -8.0))
    pairs = wild.pairs()
    row = error_row("mean", pairs, wild.scene_of_models(), wild)
    # Among the calm two the errors are small, so the wild scene's four models lie outside.
    assert float(row["inside"].removesuffix(" %")) == pytest.approx(100 * 8 / 12, abs=1)
    calm = error_row("mean", known.pairs(), known.scene_of_models(), known)
    assert calm["rms error [dB]"] < 1.2 < calm["of a constant [dB]"] + 1.0


def test_the_page_and_the_calibration(known, tmp_path):
    write_page(tmp_path, known)
    found = read_calibration(tmp_path / "calibration.json")
    assert found == known.calibration()
    page = (tmp_path / "forecast.md").read_text()
    assert all(f"| {name} | 12 |" in page for name in STATISTICS)
    assert "720 views of 12 models in scene0, scene1, scene2" in page
    assert (tmp_path / "forecast.png").read_bytes().startswith(b"\x89PNG")


def test_the_package_holds_the_small_calibration():
    """What is believed by default is what the committed experiment found."""
    root = experiment.Options().out
    views = read_views(root / "renderability_vs_error" / "small" / "views.csv")
    mine = views.calibration()
    packaged = read_calibration(
        root.parents[1] / "r3jax" / "apps" / "forecast" / "calibration.json"
    )
    assert packaged.source == mine.source
    np.testing.assert_allclose(packaged.model.location, mine.model.location, rtol=1e-6)
    np.testing.assert_allclose(packaged.errors["p10"], mine.errors["p10"], atol=1e-3)
