"""The fit of the expected error: by hand, from models that are made up here."""

import numpy as np
import pytest

from experiments.expected_error import (
    EXPECTED,
    Model,
    expected,
    fit_coefficients,
    left_out,
    model_rows,
    package_fit,
    pooled,
    write_page,
)
from experiments.pages.artifacts import Origin
from r3jax.scoring.expected_error import TERMS

TRUE = np.array([0.002, 0.15, 0.04, 0.006, 0.14])


def squared(model: Model) -> np.ndarray:
    return model.squared


def made_up(name: str, scene: str, factor: float = 1.0, kind: str = "captured") -> Model:
    """A model whose errors follow one law, up to a factor and a little chance."""
    random = np.random.default_rng(len(name) + ord(name[0]))
    lack, hard, unseen = random.random(60), 0.2 * random.random(60), 0.3 * random.random(60)
    terms = np.stack([np.ones(60), unseen, hard, lack**2, hard * lack], axis=1)
    error = factor * (terms @ TRUE) * np.exp(0.05 * random.standard_normal(60))
    columns = {"psnr": -10.0 * np.log10(error), "ssim": 1.0 - 8.0 * error, "lpips": error}
    columns |= {name: 1.0 - lack for name in ("R", "bias", "cover", "fisherrf", "d-opt")}
    columns |= {"coverage": 1.0 - unseen, "texture": -hard}
    return Model(name, scene, kind, terms, columns)


MODELS = [made_up("a", "one"), made_up("bb", "two"), made_up("ccc", "three")]


def test_the_coefficients_are_found_and_none_is_negative():
    found = fit_coefficients(MODELS, squared)
    assert found.min() >= 0.0
    for model in MODELS:
        np.testing.assert_allclose(expected(model, found), model.squared, rtol=0.3)
        apart = np.log(expected(model, found) / model.squared)
        assert np.sqrt(np.mean(apart**2)) < 0.08


def test_a_model_is_expected_by_a_fit_that_has_not_seen_its_scene():
    odd = [*MODELS[:2], made_up("ccc", "three", factor=8.0)]
    value = left_out(odd, squared)[2]
    assert np.median(odd[2].squared / value) == pytest.approx(8.0, rel=0.1)
    fit = package_fit(odd, squared, "psnr")
    # A third of the views is 9 dB worse than the other scenes let expect.
    assert fit.low < -8.0
    assert fit.high > 0.0
    assert len(fit.coefficients) == len(TERMS)


def test_one_scene_alone_cannot_be_left_out():
    with pytest.raises(ValueError, match="models of two scenes or more"):
        left_out(MODELS[:1], squared)


def test_the_folds_of_a_recording_are_one_model():
    folds = [made_up("a", "lounge", kind="recording"), made_up("bb", "lounge", kind="recording")]
    found = pooled([*folds, MODELS[2]])
    assert [model.name for model in found] == ["lounge", "ccc"]
    assert len(found[0].terms) == len(found[0].columns["psnr"]) == 120


def test_the_page_says_what_ranks(tmp_path):
    rows = model_rows(MODELS)
    assert all(row[f"{EXPECTED}, psnr"] > 0.95 > row["R, psnr"] for row in rows)
    write_page(tmp_path, MODELS, Origin("python", "none", "unknown"))
    page = (tmp_path / "expected_error.md").read_text()
    assert "180 views of 3 models" in page
    assert (tmp_path / "coefficients.json").exists()
