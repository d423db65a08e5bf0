"""Goals as users write them, and when they are reached."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.apps.forecast.forecast import Forecast
from r3jax.apps.forecast.psnr import Goal, default_calibration, parse_goal


@given(st.floats(-50.0, 80.0), st.sampled_from(["mean", "p10", "p50", "p2.5"]))
def test_a_goal_is_read_as_it_is_written(psnr, name):
    goal = Goal(psnr, name)
    assert parse_goal(str(goal)) == goal


def test_the_mean_is_the_default():
    assert parse_goal(" psnr:27 ") == Goal(27.0, "mean")
    assert parse_goal("psnr:27@p10") == Goal(27.0, "p10")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("27", "not understood"), ("ssim:0.9", "not understood"), ("psnr", "not understood"),
        ("psnr:high", "'high' is not a number"), ("psnr:nan", "finite"), ("psnr:inf@p10", "finite"),
        ("psnr:27@q10", "no statistic"), ("psnr:27@p100", "no statistic"),
    ],
)  # fmt: skip
def test_what_is_no_goal_is_told(text, reason):
    with pytest.raises(ValueError, match=reason):
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
