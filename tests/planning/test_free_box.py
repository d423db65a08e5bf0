"""Boxes of free space: cell by cell against the mask, as large as they may be."""

import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from r3jax.planning.refinement import refine as real
from r3jax.planning.robot.travel import Travel, plan_travel
from tests.planning.rooms import CELL, ORIGIN, center, grid_of

SHAPE = (9, 8, 7)
seeds = st.integers(0, 10_000)


def cluttered(seed: int) -> tuple[Travel, np.ndarray]:
    """Free space with holes, and a place somewhere in it."""
    rng = np.random.default_rng(seed)
    free = rng.random(SHAPE) < rng.uniform(0.92, 1.0)
    start = tuple(rng.integers(0, SHAPE))
    free[start] = True
    travel = plan_travel(grid_of(free), center(*start), safety_margin=0.15)
    cells = np.argwhere(travel.reachable)
    return travel, center(*(cells[rng.integers(len(cells))] + rng.uniform(-0.45, 0.45, 3)))


def law_free(seed: int = 0) -> None:
    """Every cell that the box reaches into is a stop; it holds the place and ends in reach."""
    travel, place = cluttered(seed)
    radius = float(np.random.default_rng(seed).uniform(0.05, 0.7))
    low, high = real.free_box(travel, place, radius)
    assert np.all(low <= place)
    assert np.all(place <= high)
    assert np.all(np.maximum(place - low, high - place) <= radius + 1e-9)
    if not travel.safe[travel.cell_of(place)]:
        np.testing.assert_array_equal(np.stack([low, high]), np.stack([place, place]))
        return
    first, last = (np.floor((corner - ORIGIN) / CELL).astype(int) for corner in (low, high))
    for cell in itertools.product(*(range(a, b + 1) for a, b in zip(first, last, strict=True))):
        assert travel.safe[cell]
        assert travel.reachable[cell]
    # As candidates do, it keeps a quarter of a cell from where another cell begins.
    assert np.all(((low - ORIGIN) / CELL % 1.0 > 0.25 - 1e-6) | (low == place))
    assert np.all(((high - ORIGIN) / CELL % 1.0 < 0.75 + 1e-6) | (high == place))


@given(seeds)
def test_a_box_is_free(seed):
    law_free(seed)


def law_large(seed: int = 0) -> None:
    """No layer of cells beside the box is free as a whole, unless it is out of reach."""
    travel, place = cluttered(seed)
    if not travel.safe[travel.cell_of(place)]:
        return
    radius = 0.5
    low, high = real.free_box(travel, place, radius)
    first, last = (np.floor((corner - ORIGIN) / CELL).astype(int) for corner in (low, high))
    stops = travel.safe & travel.reachable
    for axis, (end, step) in itertools.product(range(3), ((first, -1), (last, 1))):
        beyond = end[axis] + step
        layer = [slice(a, b + 1) for a, b in zip(first, last, strict=True)]
        layer[axis] = slice(beyond, beyond + 1)
        nearest = ORIGIN[axis] + (beyond + (0.75 if step < 0 else 0.25)) * CELL
        if 0 <= beyond < SHAPE[axis] and abs(nearest - place[axis]) < radius - 1e-6:
            assert not stops[tuple(layer)].all()


@given(seeds)
def test_a_box_is_as_large_as_it_may_be(seed):
    law_large(seed)


def test_in_the_open_a_box_ends_at_the_radius():
    travel = plan_travel(grid_of(np.ones((15, 15, 15), bool)), center(7, 7, 7))
    low, high = real.free_box(travel, center(7, 7, 7), 0.33)
    np.testing.assert_allclose(low, center(7, 7, 7) - 0.33)
    np.testing.assert_allclose(high, center(7, 7, 7) + 0.33)


def test_where_the_margin_is_not_kept_nothing_moves():
    """The robot's own cell, beside a wall: it may stay there and no more."""
    free = np.zeros((15, 15, 15), bool)
    free[1:14, 1:14, 1:14] = True
    place = center(1, 7, 7)
    low, high = real.free_box(plan_travel(grid_of(free), place), place, 0.4)
    np.testing.assert_array_equal(low, place)
    np.testing.assert_array_equal(high, place)


def test_a_carrier_keeps_its_heights() -> None:
    heights = (float(center(7, 7, 7)[2] - 0.02), float(center(7, 7, 7)[2] + 0.03))
    open_space = grid_of(np.ones((15, 15, 15), bool))
    travel = plan_travel(open_space, center(7, 7, 7), heights=heights)
    low, high = real.free_box(travel, center(7, 7, 7), 0.4)
    assert heights[0] <= low[2] <= high[2] <= heights[1]
    np.testing.assert_allclose((high - low)[:2], 0.8)
