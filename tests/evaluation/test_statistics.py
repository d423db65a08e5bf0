"""Means over scenes and differences of methods: laws and closed forms of their intervals."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.evaluation.comparison import mean_over_scenes, paired_difference

seeds = st.integers(0, 2**32 - 1)


def interval(estimate):
    return (estimate.low, estimate.high)


def scores(seed, shape=(3, 25), scenes=("flat", "house")):
    rng = np.random.default_rng(seed)
    return {scene: rng.normal(25.0, 3.0, shape) for scene in scenes}


def test_mean() -> None:
    """Scenes weigh the same; missing views do not count; the order of scenes does not matter."""
    mean = mean_over_scenes
    uneven = {"a": np.full((2, 10), 20.0), "b": np.full((2, 90), 30.0)}
    found = mean(uneven)
    assert (found.value, found.low, found.high) == pytest.approx((25.0, 25.0, 25.0))
    assert found.count == 100
    some = scores(4)
    assert mean(dict(reversed(some.items()))) == mean(some)
    holes = {k: np.concatenate([v, np.full((3, 2), np.nan)], axis=1) for k, v in some.items()}
    assert mean(holes) == mean(some)
    low, high = interval(mean(some))
    assert low < np.mean([v.mean() for v in some.values()]) < high


def test_crossed() -> None:
    """Views that are hard for all seeds: the interval is that of the views, not of S x V values."""
    mean, rng = mean_over_scenes, np.random.default_rng(5)
    views, by_seed = rng.normal(25.0, 3.0, 300), rng.normal(0.0, 2.0, 12)
    same = mean({"a": np.tile(views, (12, 1))}, resamples=2000)
    expected = 2 * 1.96 * views.std() / math.sqrt(300)
    assert same.high - same.low == pytest.approx(expected, rel=0.1)
    moved = mean({"a": np.tile(by_seed[:, None], (1, 300))}, resamples=2000)
    expected = 2 * 1.96 * by_seed.std() / math.sqrt(12)
    assert moved.high - moved.low == pytest.approx(expected, rel=0.1)


def test_paired() -> None:
    """What both methods share cancels; the exchange of the methods turns the sign."""
    difference = paired_difference
    first, noise = scores(8), scores(9)
    second = {scene: first[scene] - 1.0 for scene in first}
    found = difference(first, second)
    assert (found.value, found.low, found.high) == pytest.approx((1.0, 1.0, 1.0))
    there, back = difference(first, noise, seed=3), difference(noise, first, seed=3)
    assert (back.value, back.low, back.high) == pytest.approx(
        (-there.value, -there.high, -there.low), abs=1e-12
    )
    close = {scene: first[scene] - 0.1 * noise[scene] for scene in first}
    tight, loose = difference(first, close), mean_over_scenes(first)
    assert tight.high - tight.low < 0.2 * (loose.high - loose.low)


@given(seeds, st.integers(1, 3), st.integers(1, 20))
def test_the_interval_of_symmetric_data_holds_its_mean(seed, num_seeds, half):
    rng = np.random.default_rng(seed)
    side = rng.uniform(0.5, 3.0, (num_seeds, half))
    values = {"scene": 25.0 + np.concatenate([side, -side], axis=1)}
    found = mean_over_scenes(values, resamples=400)
    assert found.low <= 25.0 + 1e-9
    assert found.high >= 25.0 - 1e-9
    assert found.value == pytest.approx(25.0)


def test_mistakes_are_named():
    with pytest.raises(ValueError, match="no scene"):
        mean_over_scenes({})
    with pytest.raises(ValueError, match="flat"):
        mean_over_scenes({"flat": np.array([[1.0, np.nan], [1.0, 2.0]])})
    with pytest.raises(ValueError, match="flat"):
        mean_over_scenes({"flat": np.full((2, 2), np.nan)})
    with pytest.raises(ValueError, match=r"'a'.*'b'"):
        paired_difference(scores(0, scenes=("a",)), scores(0, scenes=("b",)))
    with pytest.raises(ValueError, match=r"a: .*\(3, 25\).*\(2, 25\)"):
        paired_difference(scores(0, scenes="a"), scores(0, (2, 25), "a"))
