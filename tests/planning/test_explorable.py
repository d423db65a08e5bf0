"""Space that can never be seen does not count as unexplored.

Mutants tried by hand, each caught here: all unexplored cells kept; connection over edges and
corners; only the first layer kept; free space that the robot cannot enter taken as reachable.
"""

import numpy as np

from r3jax.planning.robot.explorable import explorable_cells, mask_unexplorable
from r3jax.planning.robot.travel import plan_travel
from tests.planning.rooms import center, grid_of


def flood(mask: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """Cells of the mask that connect to the seeds over faces, one layer at a time."""
    reached = mask & seeds
    while True:
        padded = np.pad(reached, 1)
        grown = reached.copy()
        for axis in range(3):
            for shift in (-1, 1):
                grown |= np.roll(padded, shift, axis)[1:-1, 1:-1, 1:-1]
        grown &= mask
        if np.array_equal(grown, reached):
            return reached
        reached = grown


def neighbors(mask: np.ndarray) -> np.ndarray:
    """Cells with a face neighbor in the mask."""
    padded = np.pad(mask, 1)
    shifted = [np.roll(padded, s, a)[1:-1, 1:-1, 1:-1] for a in range(3) for s in (-1, 1)]
    return np.any(shifted, axis=0)


def test_a_wall_cuts_off_what_lies_behind_it():
    free = np.zeros((14, 9, 9), bool)
    occupied = np.zeros_like(free)
    free[2:6, 2:7, 2:7] = True
    occupied[6] = True  # a wall right across the grid
    unexplored = ~(free | occupied)
    kept = explorable_cells(free, unexplored, free)
    np.testing.assert_array_equal(kept, unexplored & (np.arange(14) < 6)[:, None, None])


def test_one_hole_in_the_wall_is_enough_but_a_diagonal_one_is_not():
    free = np.zeros((14, 9, 9), bool)
    occupied = np.zeros_like(free)
    free[2:6, 2:7, 2:7] = True
    occupied[6] = True
    occupied[6, 4, 4] = False
    unexplored = ~(free | occupied)
    np.testing.assert_array_equal(explorable_cells(free, unexplored, free), unexplored)
    occupied[:7] |= ~free[:7]
    occupied[6, 4, 4] = True
    occupied[6, 1, 4] = False  # touches free space at an edge only
    unexplored = ~(free | occupied)
    assert not explorable_cells(free, unexplored, free).any()


def test_free_space_that_cannot_be_entered_does_not_count():
    """Seen through a window: free cells outside, cut off from the robot's own."""
    free = np.zeros((14, 9, 9), bool)
    free[2:5, 2:7, 2:7] = free[8:11, 2:7, 2:7] = True
    occupied = np.zeros_like(free)
    occupied[6] = True
    inside = free & (np.arange(14) < 6)[:, None, None]
    kept = explorable_cells(free, ~(free | occupied), inside)
    assert kept[5, 4, 4]
    assert not kept[7:].any()


def test_it_is_a_flood_fill_from_the_reachable_space():
    rng = np.random.default_rng(3)
    for _ in range(20):
        kind = rng.choice(3, size=(8, 7, 6), p=[0.35, 0.35, 0.3])
        free, unexplored = kind == 0, kind == 1
        reached = np.zeros_like(free)
        reached[tuple(rng.integers(0, free.shape))] = True
        expected = flood(unexplored, neighbors(flood(free, reached)))
        np.testing.assert_array_equal(explorable_cells(free, unexplored, reached), expected)


def test_the_masked_grid_differs_only_in_hopeless_cells():
    free = np.zeros((12, 9, 9), bool)
    occupied = np.zeros_like(free)
    free[1:6, 1:8, 1:8] = True
    occupied[6] = True
    grid = grid_of(free, occupied)
    masked = mask_unexplorable(grid, plan_travel(grid, center(3, 4, 4)).reachable)
    np.testing.assert_array_equal(masked.log_odds, grid.log_odds)
    assert not bool(masked.unexplored[7:].any())
    np.testing.assert_array_equal(masked.unexplored[:7], grid.unexplored[:7])


def test_masks_add_up_and_what_is_known_stays():
    free = np.zeros((4, 3, 3), bool)
    free[0] = True
    grid = grid_of(free)
    first, second = np.zeros_like(free), np.zeros_like(free)
    first[:2], second[2] = True, True
    masked = grid.ignoring(first).ignoring(second)
    np.testing.assert_array_equal(masked.unexplored, (np.arange(4) == 3)[:, None, None] & ~free)
    np.testing.assert_array_equal(masked.free, grid.free)
    assert not masked.occupied.any()
    assert grid.explorable is None
