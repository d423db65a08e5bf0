"""Where people could stand: in the open, near where the camera was, away from everything."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.captures import standpoints
from r3jax.captures.standpoints import (
    inward_center,
    places_in_free_space,
    places_in_hull,
    places_of,
    places_on_dome,
)
from r3jax.captures.survey import MARGIN
from r3jax.kernels.constants import LOG_ODDS_LIMIT
from r3jax.mapping.occupancy import OccupancyGrid, empty_grid
from r3jax.mapping.state import empty_map
from tests.apps.audit.room import pose_at


def grid_of(free: np.ndarray) -> OccupancyGrid:
    """Cells of 0.2 m from the origin: free, and else occupied."""
    grid = empty_grid(np.array([[0.2, 0.2, 0.2], (np.array(free.shape) - 1) * 0.2]), 0.2)
    assert grid.log_odds.shape == free.shape
    odds = np.where(free, -LOG_ODDS_LIMIT, LOG_ODDS_LIMIT).astype(np.float32)
    return eqx.tree_at(lambda g: g.log_odds, grid, jnp.asarray(odds))


def two_rooms() -> np.ndarray:
    """Two rooms of 3 x 3 x 2.4 m side by side, with a wall without a door between them."""
    free = np.zeros((33, 17, 14), bool)
    free[1:16, 1:16, 1:13] = free[17:32, 1:16, 1:13] = True
    return free


def test_places_lie_in_the_room_of_the_camera_at_its_heights_with_a_margin():
    grid = grid_of(two_rooms())
    cameras = np.array([[1.0, 1.0, 1.3], [2.0, 1.5, 1.5]])
    places = places_in_free_space(grid, cameras)
    assert len(places) > 100
    assert (places[:, 0] < 3.2).all()  # nobody walks through the wall
    assert np.abs(places[:, 2] - 1.4).max() <= 0.1 + MARGIN + 1e-6
    walls = np.array([[0.2, 0.2], [3.2, 3.2]])
    assert (np.abs(places[:, None, :2] - walls[None]).min(axis=(1, 2)) >= MARGIN - 1e-6).all()


def test_surfaces_are_evaluated_from_near_the_pictures_even_if_a_door_opens_far_away():
    closed, opened = two_rooms(), two_rooms()
    opened[15:18, 4:13, 1:13] = True  # a doorway, wide enough to walk through
    cameras = np.array([[1.0, 1.5, 1.4], [1.4, 1.7, 1.4]])
    found = [
        places_of(empty_map(64, 0.05), grid_of(free), cameras, 64, is_dense=True, meter=1.0)
        for free in (closed, opened)
    ]
    assert found[0].eyes[:, 0].max() < 3.2 < found[1].eyes[:, 0].max()
    for places in found:
        gap = np.linalg.norm(places.standpoints[:, None] - cameras, axis=2).min(axis=1)
        assert gap.max() <= 1.5
    np.testing.assert_array_equal(found[0].standpoints, found[1].standpoints)


def test_a_camera_close_to_a_wall_still_means_its_room():
    places = places_in_free_space(grid_of(two_rooms()), np.array([[0.3, 0.3, 1.4]]))
    assert len(places) > 20
    assert (places[:, 0] < 3.2).all()


def test_nothing_is_reached_from_inside_a_wall_far_away():
    far = np.array([[40.0, 1.0, 1.4]])
    assert len(places_in_free_space(grid_of(two_rooms()), far)) == 0
    assert len(places_in_free_space(grid_of(np.zeros((5, 5, 5), bool)), far)) == 0


@given(st.integers(0, 500))
def test_the_hull_keeps_its_margins(seed):
    rng = np.random.default_rng(seed)
    cameras = rng.uniform(0, 3, (int(rng.integers(1, 7)), 3))
    cameras[:, 2] = 1.4  # flat, as most captures
    voxels = rng.uniform(-1, 4, (60, 3))
    places = places_in_hull(cameras, voxels)
    for place in places:
        assert np.linalg.norm(voxels - place, axis=1).min() >= MARGIN - 1e-9
        assert abs(place[2] - 1.4) <= MARGIN + 1e-9
        # A supporting direction of the hull would show a place outside of it.
        directions = rng.normal(size=(20, 3))
        support = (cameras @ directions.T).max(axis=0) + MARGIN * np.abs(directions).sum(axis=1)
        assert (directions @ place <= support + 1e-9).all()


def test_one_camera_alone_leaves_the_box_round_it():
    places = places_in_hull(np.array([[1.0, 2.0, 3.0]]), np.array([[9.0, 9.0, 9.0]]))
    assert len(places) > 4
    assert np.abs(places - [1, 2, 3]).max() <= MARGIN


@given(
    middle=st.tuples(*[st.floats(-3, 3)] * 3), height=st.floats(0.2, 1.5), seed=st.integers(0, 99)
)
def test_cameras_round_an_object_are_told_from_cameras_in_a_room(middle, height, seed):
    rng = np.random.default_rng(seed)
    middle = np.array(middle)
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    ring = np.stack([2 * np.cos(angles), 2 * np.sin(angles), np.full(12, height)], axis=1)
    target = middle + 0.1 * rng.normal(size=(12, 3))
    round_it = np.stack([pose_at(middle + r, t) for r, t in zip(ring, target, strict=True)])
    surface = middle + 0.3 * rng.normal(size=(60, 3))
    found = inward_center(round_it, surface)
    assert found is not None
    assert np.linalg.norm(found - middle) < 0.3
    places = places_on_dome(round_it[:, :3, 3], found, surface)
    assert len(places) > 50
    off = np.linalg.norm(places - found, axis=1) / np.linalg.norm(ring[0])
    assert (np.abs(off - 1.0) < 0.2).all()
    outward = np.stack([pose_at(middle + r, middle + 2 * r) for r in ring])
    assert inward_center(outward, middle + 5 * ring) is None
    # Walls all round, seen across the room, are no object.
    assert inward_center(round_it, middle + 2.5 * rng.normal(size=(60, 3))) is None


@pytest.mark.parametrize(("edge", "num"), [(15.0, 8), (80.0, 128)])
def test_a_building_has_as_many_standpoints_on_its_floor_as_a_house(edge, num):
    """A camera every 2.5 m: 256 cubes of the range in 80 m, so sixteen houses."""
    steps = np.arange(0.6, edge, 2.5)
    x, y = np.meshgrid(steps, steps)
    cameras = np.stack([x.ravel(), y.ravel(), np.full(x.size, 1.5)], axis=1)
    found = standpoints._standpoints(cameras, cameras, 1.0, 8)
    assert len(found) == num
    # No camera is far from all of them.
    apart = np.linalg.norm(cameras[:, None] - found[None], axis=2).min(axis=1)
    assert apart.max() < 10.0
