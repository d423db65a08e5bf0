"""What a sweep tries: laws of grids and of random points, and words that are not understood."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.settings import known_settings
from experiments.sweep_space import (
    Listed,
    Range,
    grid_points,
    parse_axes,
    random_points,
    with_default,
)
from r3jax.apps.benchmark.cells import Conditions

KNOWN = known_settings(Conditions())


numbers = st.lists(st.integers(1, 99), min_size=1, max_size=4, unique=True)


@given(numbers, numbers)
def test_a_grid_holds_every_combination_once(first, second):
    words = [f"lambda1={','.join(map(str, first))}", f"num_bins={','.join(map(str, second))}"]
    points = grid_points(parse_axes(words, KNOWN))
    found = [(point["policy.lambda1"], point["map.num_bins"]) for point in points]
    assert found == [(a, b) for a in first for b in second]


@settings(max_examples=20)
@given(st.integers(1, 30), st.integers(0, 5), st.booleans())
def test_random_points_are_in_range_distinct_and_the_same_for_the_same_seed(count, seed, is_log):
    scale = ":log" if is_log else ""
    words = [f"lambda1=2..64{scale}", f"num_candidates=50..200{scale}", "kappa=box,one"]
    axes = parse_axes(words, KNOWN)
    points = random_points(axes, count, seed)
    assert len(points) == len({tuple(point.values()) for point in points}) == count
    for point in points:
        assert 2.0 <= point["policy.lambda1"] <= 64.0
        assert type(point["policy.num_candidates"]) is int
        assert 50 <= point["policy.num_candidates"] <= 200
        assert point["policy.kappa"] in ("box", "one")
    assert random_points(axes, count + 7, seed)[:count] == points
    assert random_points(axes, count, seed + 1) != points


def test_a_logarithmic_range_is_drawn_evenly_over_decades():
    """Half of the draws lie below the middle of their scale."""
    for scale, middle in ((":log", 100.0), ("", 5000.5)):
        axes = parse_axes([f"lambda1=1..10000{scale}"], KNOWN)
        drawn = [point["policy.lambda1"] for point in random_points(axes, 400, 0)]
        assert abs(np.mean(np.array(drawn) < middle) - 0.5) < 0.1  # four sigma


def test_whole_numbers_are_drawn_evenly_ends_included():
    """Of a range of whole numbers, all are as likely, the ends too."""
    (axis,) = parse_axes(["num_bins=3..6"], KNOWN)
    rng = np.random.default_rng(0)
    found, counts = np.unique([axis.draw(rng) for _ in range(800)], return_counts=True)
    assert found.tolist() == [3, 4, 5, 6]
    assert np.all(np.abs(counts - 200) < 60)


def test_points_differ_repeat_and_cover_the_grid():
    """Every point once, and more points begin with the same ones."""
    axes = parse_axes(["num_bins=3..5", "kappa=box,one"], KNOWN)
    grid = grid_points(parse_axes(["num_bins=3,4,5", "kappa=box,one"], KNOWN))
    points = random_points(axes, 6, 1)
    assert len(grid) == 6
    assert sorted(map(str, points)) == sorted(map(str, grid))
    assert random_points(axes, 3, 1) == points[:3]


def test_more_points_than_there_are_cannot_be_drawn():
    (axis,) = parse_axes(["num_bins=3..6"], KNOWN)
    assert len(random_points([axis], 4, 0)) == 4
    for count in (0, 5):
        with pytest.raises(ValueError, match=f"1 to 4 points of this space, got {count}"):
            random_points([axis], count, 0)


def test_the_default_is_always_tried_and_only_once():
    axes = parse_axes(["lambda1=4,8", "voxel_size=0.1"], KNOWN)
    points = with_default(grid_points(axes), axes)
    assert points[0] == {"policy.lambda1": 16.0, "map.voxel_size": 0.05}
    assert len(points) == 3
    axes = parse_axes(["lambda1=4,16"], KNOWN)
    assert with_default(grid_points(axes), axes) == grid_points(axes)


def test_names_may_be_whole_or_short_and_ranges_are_read():
    axes = parse_axes(["policy.lambda1=1..64:log", "voxel_size = 0.05, 0.1"], KNOWN)
    assert axes == (
        Range(KNOWN["policy.lambda1"], 1.0, 64.0, True),
        Listed(KNOWN["map.voxel_size"], (0.05, 0.1)),
    )
    words = ["allow_growth=true,False", "num_bins=1e2", "sh_every=none,5"]
    values = [axis.values for axis in parse_axes(words, KNOWN)]
    assert values == [(True, False), (100,), (None, 5)]


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("lambda1", "takes NAME=VALUES such as"),
        ("=4", "takes NAME=VALUES such as"),
        ("lamda1=4", r"no setting 'lamda1': did you mean policy\.lambda1"),
        ("policy.voxel_size=4", r"did you mean map\.voxel_size"),
        ("bins=4", r"did you mean map\.num_bins"),
        ("xyzzy=4", r"no setting 'xyzzy': --list shows all"),
        ("resolution=64", "no setting 'resolution'"),
        ("max_range=4", r"may be policy\.max_range or sensor\.max_range: give the whole name"),
        ("lambda1=4,many", r"policy\.lambda1 takes numbers, got 'many'"),
        ("lambda1=inf", "takes numbers, got 'inf'"),
        ("num_bins=4.5", "takes whole numbers, got '4.5'"),
        ("drop_edges=yes", "takes true or false, got 'yes'"),
        ("lambda1=4,4.0", "has a value twice"),
        ("lambda1=4..2", "a range needs LOW < HIGH"),
        ("lambda1=0..2:log", "LOW < HIGH and LOW > 0"),
        ("lambda1=1..2:ln", r"LOW\.\.HIGH or LOW\.\.HIGH:log"),
        ("kappa=box..one", "only of numbers"),
    ],
)
def test_a_word_that_is_not_understood_is_named(word, message):
    with pytest.raises(ValueError, match=message):
        parse_axes([word], KNOWN)


def test_a_setting_given_twice_and_a_grid_over_a_range_are_refused():
    with pytest.raises(ValueError, match=r"policy\.lambda1 is given twice"):
        parse_axes(["lambda1=4", "policy.lambda1=8"], KNOWN)
    with pytest.raises(ValueError, match=r"policy\.lambda1 has a range.*--random"):
        grid_points(parse_axes(["lambda1=1..4"], KNOWN))
