"""Cells closed by what carries the camera: a table by hand, cells one by one, and ways past it."""

import itertools

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from r3jax.planning.robot import travel
from r3jax.planning.robot.travel import plan_travel
from tests.planning.rooms import CELL, ORIGIN, center, grid_of, two_rooms
from tests.planning.test_travel import assert_inside

SHAPE = (8, 7, 9)
LOW = float(ORIGIN[2])


def closed_one_by_one(occupied, body, margin, heights) -> np.ndarray:
    """Every cell against every occupied one, from the definition; heights within the grid."""
    closed = np.zeros(occupied.shape, bool)
    for x, y, z in itertools.product(*(range(n) for n in occupied.shape)):
        bottom = LOW + z * CELL
        if bottom + CELL <= heights[0] or bottom > heights[1]:
            continue
        top = max(bottom, heights[0])
        for i, j, k in np.argwhere(occupied):
            is_below = k < z and LOW + (k + 1) * CELL > top - body + 1e-9
            gap = np.hypot(max(abs(i - x) - 0.5, 0.0), max(abs(j - y) - 0.5, 0.0)) * CELL
            closed[x, y, z] |= is_below and gap < margin - 1e-9
    return closed


@given(st.integers(0, 1000))
@example(0)
@settings(max_examples=10)
def test_cells_are_closed_as_defined(seed):
    rng = np.random.default_rng(seed)
    occupied = rng.random(SHAPE) < 0.02
    for body, margin in ((0.45, 0.3), (0.93, 0.5), (5.0, 0.05)):
        for heights in ((LOW, LOW + 1.79), (LOW + 1.13, LOW + 1.13), (LOW + 0.71, LOW + 1.33)):
            arguments = occupied, body, margin, heights, LOW, CELL
            closed = travel.cells_over_matter(*arguments)
            expected = closed_one_by_one(occupied, body, margin, heights)
            np.testing.assert_array_equal(closed, expected)
            assert expected.any() or seed != 0
    nobody = travel.cells_over_matter(occupied, 0.0, 0.3, (0.0, 3.0), LOW, CELL)
    assert not nobody.any()


def test_unlimited() -> None:
    """Without limits of height every cell over matter is closed, however tall the grid."""
    occupied = np.zeros(SHAPE, bool)
    occupied[4, 3, 2] = True
    everywhere = (-np.inf, np.inf)
    closed = travel.cells_over_matter(occupied, 0.5, 0.05, everywhere, LOW, CELL)
    np.testing.assert_array_equal(np.argwhere(closed), [[4, 3, 3], [4, 3, 4], [4, 3, 5]])


def with_table() -> tuple[np.ndarray, np.ndarray]:
    """Two rooms; a table of one layer across the first one, but for its far end."""
    free, occupied = two_rooms()
    free[6:8, 1:9, 3], occupied[6:8, 1:9, 3] = False, True
    return free, occupied


def test_round_the_table() -> None:
    """A robot goes round a table that a camera flies over; it never leaves its height."""
    start, goal = center(3, 3, 6), center(10, 3, 6)
    grid = grid_of(*with_table())
    plan, height = travel.plan_travel, (float(start[2]), float(start[2]))
    flying = plan(grid, start)
    np.testing.assert_array_equal(flying.path(goal), [start, goal])
    robot = plan(grid, start, heights=height, body=0.8)
    way = robot.path(goal)
    assert np.all(way[:, 2] == start[2])
    assert way[:, 1].max() > center(0, 9, 0)[1]
    assert robot.lengths(goal[None])[0] >= np.linalg.norm(np.diff(way, axis=0), axis=1).sum()
    assert set(np.nonzero(robot.goals)[2]) == {6}
    assert not robot.usable[5:9, 1:9].any()
    # Its wheels pass what is no higher than the body reaches down.
    over = plan(grid, start, heights=height, body=0.35)
    np.testing.assert_array_equal(over.path(goal), [start, goal])


def test_level() -> None:
    """Off the middle of its layer the robot stays off it, round corners too."""
    start, goal = center(3, 3, 6.35), center(10, 3, 6.35)
    height = (float(start[2]), float(start[2]))
    robot = travel.plan_travel(grid_of(*with_table()), start, heights=height, body=0.8)
    assert len(robot.path(goal)) > 2
    assert np.all(robot.path(goal)[:, 2] == start[2])


@given(
    height=st.one_of(st.floats(1.25, 1.75), st.sampled_from([1.3, 1.5, 1.7])),
    x=st.floats(2.0, 10.0),
    y=st.floats(2.0, 11.0),
)
def test_ways_at_any_fixed_height_are_level_and_safe(height, x, y):
    """Heights on the border of two layers too: the layer is that of the camera's own cell."""
    position = center(x, y, 0)
    position[2] = height
    robot = plan_travel(grid_of(*two_rooms()), position, heights=(height, height), body=0.0)
    cells = np.argwhere(robot.goals)
    assert set(cells[:, 2]) == {robot.start_cell[2]}
    far = robot.stops(cells[np.argmax(cells[:, 0])][None])[0]
    way = robot.path(far)
    assert np.all(way[:, 2] == height)
    layer = robot.usable[:, :, robot.start_cell[2]]
    level = way.copy()
    level[:, 2] = center(0, 0, robot.start_cell[2])[2]
    assert_inside(layer[:, :, None] & np.ones(10, bool), level)
    straight = robot.lengths((position + np.array([0.05, 0.0, 0.0]))[None])
    assert straight[0] == pytest.approx(0.05)


def test_a_camera_beyond_its_heights_is_told():
    with pytest.raises(ValueError, match=r"1\.800 m"):
        plan_travel(grid_of(*two_rooms()), center(6, 6, 6), heights=(0.6, 1.2))
