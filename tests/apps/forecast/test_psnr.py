"""The PSNR of views from coverage and renderability: fitted, mixed, and left-out scenes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.apps.forecast import psnr as real
from r3jax.apps.forecast.forecast import Forecast
from r3jax.apps.forecast.psnr import (
    PERCENTILES,
    Calibration,
    Goal,
    PsnrModel,
    default_calibration,
    parse_goal,
)
from r3jax.errors import InputError

TRUE = PsnrModel((5.0, 20.0, -6.0, 8.0), (0.5, 0.4, -0.6), (-1.0, 0.0, 1.0))
seeds = st.integers(0, 1000)


def views_of(seed: int, num: int = 3000, offset: float = 0.0):
    """Views whose PSNR follows a known model with normal noise: coverage, R, PSNR."""
    rng = np.random.default_rng(seed)
    coverage = rng.beta(2.0, 1.0, num)
    renderability = coverage * rng.random(num)
    mean = 5.0 + offset + 20.0 * coverage - 6.0 * coverage**2 + 8.0 * renderability
    scale = np.exp(0.5 + 0.4 * coverage - 0.6 * renderability)
    return coverage, renderability, mean + scale * rng.standard_normal(num)


@given(seeds)
def test_a_fit_finds_the_law_of_its_views(seed):
    """Quantiles of the mixture are those of views drawn anew from the same law."""
    model = real.fit(*views_of(seed))
    coverage, renderability, truth = views_of(seed + 1, 20_000)
    mixture = model.mixture(coverage, renderability)
    assert mixture.shape == (20_000, len(model.residuals))
    for name, tolerance in (("mean", 0.25), ("p10", 0.4), ("p50", 0.3), ("p90", 0.5)):
        found = real.statistic(mixture, name)
        assert found == pytest.approx(real.statistic(truth, name), abs=tolerance)
    # What one view tells is as wide as its own noise, not as that of all views.
    sure, unsure = model.mixture(np.array([0.9, 0.9]), np.array([0.9, 0.0]))
    assert (sure - unsure).mean() == pytest.approx(8.0 * 0.9, abs=0.8)
    wide = (np.percentile(unsure, 84) - np.percentile(unsure, 16)) / 2.0
    narrow = (np.percentile(sure, 84) - np.percentile(sure, 16)) / 2.0
    # Less than in truth: what is added to residuals before their logarithm makes them more alike.
    assert 1.2 < wide / narrow < 1.1 * np.exp(0.6 * 0.9)


def test_a_mixture_by_hand():
    mixture = TRUE.mixture(np.array([0.5]), np.array([0.25]))
    mean, scale = 5.0 + 10.0 - 1.5 + 2.0, np.exp(0.5 + 0.2 - 0.15)
    np.testing.assert_allclose(mixture, [[mean - scale, mean, mean + scale]])


def test_a_scene_left_out_is_not_learned_from():
    """A scene that is 3 dB worse than all others is forecast 3 dB too high; the others suffer."""
    parts = [views_of(seed, 600, offset) for seed, offset in enumerate((0.0, 0.0, -3.0))]
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    scenes = np.repeat(["a", "b", "worse"], 600).tolist()
    models = np.repeat([f"model {i}" for i in range(6)], 300).tolist()
    pairs = real.leave_one_out(*columns, scenes, models)
    assert len(pairs) == 6
    errors = np.array([pair["mean"][0] - pair["mean"][1] for pair in pairs])
    np.testing.assert_allclose(errors[4:], 3.0, atol=0.6)
    np.testing.assert_allclose(errors[:4], -1.5, atol=0.6)  # half of what they learn from is worse
    sizes = real.errors_of(pairs)["mean"]
    assert sizes == tuple(sorted(sizes))
    np.testing.assert_allclose(sizes, np.sort(np.abs(errors)), atol=1e-4)


def test_a_width_between_percentiles_is_interpolated():
    errors = {name: (1.0, 2.0, 3.0) for name in real.STATISTICS}
    errors |= {"p10": (2.0, 4.0, 6.0), "p25": (4.0, 6.0, 8.0)}
    known = real.Calibration(TRUE, errors, "nothing")
    assert known.half_width("mean", 0.5) == 2.0
    assert known.half_width("mean", 1.0) == 3.0
    assert known.half_width("p10", 0.5) == 4.0
    assert known.half_width("p20", 0.5) == pytest.approx(4.0 + 2.0 * 10 / 15)  # between p10 and p25
    assert known.half_width("p1", 0.5) == known.half_width("p5", 0.5)


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.floats(0.0, 0.2))
def test_the_package_expects_more_of_more(coverage, share, more):
    """More coverage, or more renderability, never lowers the expected PSNR of a view."""
    model = default_calibration().model
    expect = lambda C, R: model.mixture(np.array([C]), np.array([R])).mean()
    before = expect(coverage, share * coverage)
    wider = min(1.0, coverage + more)
    assert expect(wider, share * coverage) >= before - 1e-9
    assert expect(coverage, min(coverage, share * coverage + more)) >= before - 1e-9


def test_the_package_knows_its_errors():
    """Every error of the calibration is a size; a wider interval is of a higher level."""
    known = default_calibration()
    assert isinstance(known, Calibration)
    for percent in PERCENTILES:
        widths = [known.half_width(f"p{percent}", level) for level in (0.5, 0.8, 0.95)]
        assert 0.0 < widths[0] < widths[1] < widths[2]


@pytest.mark.parametrize("name", ["p0", "p100", "10", "pp", "median", "p-5", ""])
def test_what_is_no_statistic_is_told(name):
    with pytest.raises(InputError):
        real.percent_of(name)


def test_a_fit_refuses_what_it_cannot_use():
    coverage, renderability, psnr = views_of(0, 200)
    with pytest.raises(ValueError, match="100"):
        real.fit(coverage[:50], renderability[:50], psnr[:50])
    with pytest.raises(ValueError, match="view 7"):
        real.fit(coverage, renderability, np.where(np.arange(200) == 7, np.nan, psnr))
    with pytest.raises(InputError):
        real.leave_one_out(coverage, renderability, psnr, ["a"] * 200, ["m"] * 200)


@given(st.floats(-50.0, 80.0), st.sampled_from(["mean", "p10", "p50", "p2.5"]))
def test_a_goal_is_read_as_it_is_written(psnr, name):
    goal = Goal(psnr, name)
    assert parse_goal(str(goal)) == goal


def test_the_mean_is_the_default():
    assert parse_goal(" psnr:27 ") == Goal(27.0, "mean")
    assert parse_goal("psnr:27@p10") == Goal(27.0, "p10")


@pytest.mark.parametrize(
    "text",
    [
        "27",
        "ssim:0.9",
        "psnr",
        "psnr:high",
        "psnr:nan",
        "psnr:inf@p10",
        "psnr:27@q10",
        "psnr:27@p100",
    ],
)
def test_what_is_no_goal_is_told(text):
    with pytest.raises(ValueError, match=f"goal {text!r}"):
        parse_goal(text)


def test_a_goal_asks_for_its_own_statistic():
    """Ten equally likely values 11 .. 20: the mean is 15.5, p10 is 11.9."""
    forecast = Forecast(np.arange(11.0, 21.0), default_calibration())
    assert Goal(15.5).reached(forecast)
    assert not Goal(15.51).reached(forecast)
    assert Goal(11.9, "p10").reached(forecast)
    assert not Goal(12.0, "p10").reached(forecast)


def test_nothing_is_reached_without_a_view():
    assert not Goal(-1000.0).reached(Forecast(np.zeros(0), default_calibration()))
