"""Where somebody stands: on the floor, never in the furniture, no farther than an arm reaches."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.captures.ground import ground_of
from r3jax.mapping.occupancy import OccupancyGrid
from tests.captures.test_standpoints import grid_of

CELL = 0.2
ROOM = (32, 26, 14)
"""Cells; the outer layer is floor, walls and ceiling: 6 x 4.8 x 2.4 m inside."""

SOFA = np.array([[2.0, 1.6], [4.4, 3.2]])
"""Lower and upper corner on the ground [m]: too wide for an arm to reach across."""


def room(height: float = 0.6) -> tuple[OccupancyGrid, np.ndarray]:
    """A room with a sofa in its middle, and the voxels of floor and sofa."""
    free = np.zeros(ROOM, bool)
    free[1:-1, 1:-1, 1:-1] = True
    low, high = np.rint(SOFA / CELL).astype(int)
    free[low[0] : high[0], low[1] : high[1], 1 : 1 + round(height / CELL)] = False
    x, y = (np.arange(0.025, n * CELL, 0.05) for n in ROOM[:2])
    plane = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    inside = np.all((plane > SOFA[0]) & (plane < SOFA[1]), axis=1)
    level = np.where(inside, 0.2 + height, 0.2) - 0.025
    return grid_of(free), np.column_stack([plane, level])


def walk(held: float = 1.5, count: int = 40) -> np.ndarray:
    """Cameras on a way round the sofa."""
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    return np.column_stack(
        [3.2 + 2.2 * np.cos(angle), 2.4 + 1.7 * np.sin(angle), np.full(count, 0.2 + held)]
    )


def test_the_floor_is_found_below_whoever_walked():
    grid, voxels = room()
    ground = ground_of(grid, voxels, walk(), 1.0)
    assert ground is not None
    np.testing.assert_allclose(ground.floor(walk()), 0.175, atol=0.05)


@given(st.integers(0, 100), st.sampled_from([0.4, 0.6, 0.8]), st.floats(1.2, 1.8))
def test_feet_are_on_the_floor_and_within_reach(seed, height, held):
    grid, voxels = room(height)
    ground = ground_of(grid, voxels, walk(held), 1.0)
    assert ground is not None
    rng = np.random.default_rng(seed)
    places = np.column_stack(
        [rng.uniform(0.5, 5.9, 50), rng.uniform(0.5, 4.7, 50), rng.uniform(1.2, 1.9, 50)]
    )
    found = ground.footing(places)
    feet = found.feet[found.is_reached]
    assert len(feet)
    # The body is round: its edge keeps out of the sofa, up to the cells' size.
    assert not np.all((feet[:, :2] > SOFA[0]) & (feet[:, :2] < SOFA[1]), axis=1).any()
    out = np.linalg.norm(feet[:, :2] - places[found.is_reached, :2], axis=1)
    assert out.max() <= 0.6 + 1e-6
    assert (out[~found.is_over[found.is_reached]] == 0.0).all()
    middle = ground.footing(np.array([[*SOFA.mean(axis=0), 1.5]]))
    assert not middle.is_reached[0]
    assert middle.is_over[0]


def test_an_arm_reaches_over_the_edge_of_the_sofa():
    grid, voxels = room()
    ground = ground_of(grid, voxels, walk(), 1.0)
    assert ground is not None
    found = ground.footing(np.array([[SOFA[0, 0] + 0.1, 2.4, 1.5]]))
    assert found.is_over[0]
    assert found.is_reached[0]
    assert found.feet[0, 0] < SOFA[0, 0]


@given(st.sampled_from([0.6, 0.8]), st.floats(0.5, 0.8), st.integers(0, 20))
def test_a_table_below_all_cameras_is_no_floor(height, held, seed):
    grid, voxels = room(height)
    rng = np.random.default_rng(seed)
    inside = SOFA[0] + (SOFA[1] - SOFA[0]) * rng.random((60, 2))
    # Those near the edge, where an arm reaches: else no one could have held them.
    near = inside[np.minimum(inside - SOFA[0], SOFA[1] - inside).min(axis=1) < 0.4]
    cameras = np.column_stack([near, np.full(len(near), 0.2 + height + held)])
    ground = ground_of(grid, voxels, cameras, 1.0)
    assert ground is not None
    np.testing.assert_allclose(ground.floor(cameras), 0.175, atol=0.05)


@pytest.mark.parametrize("meter", [1.0, None])
def test_where_nobody_walked_nothing_is_said_of_standing(meter):
    grid, voxels = room()
    low = walk(held=0.1)  # a turntable, a toy car: known meters tell; without, a small person may
    assert meter is None or ground_of(grid, voxels, low, meter) is None
    blind = grid_of(np.ones(ROOM, bool))  # nothing below was ever seen
    assert ground_of(blind, voxels, walk(), meter) is None
