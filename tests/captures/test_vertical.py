"""Which way is up: places and ways to hold a camera whose vertical is known, turned at random."""

import numpy as np
import pytest

from r3jax.captures.vertical import Normals, Vertical, block_normals, estimated_up
from r3jax.geometry.cameras import Camera
from tests.apps.audit import held
from tests.apps.audit.held import held_pose, turned
from tests.formats.colmap_models import random_rotation

CAMERA = Camera(160, 120, 120.0, 120.0, 80.0, 60.0)


def error(found: Vertical, up: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(found.direction @ up, -1.0, 1.0))))


def estimate(place: held.Place, poses: list[np.ndarray], seed: int) -> tuple[Vertical, float]:
    """The vertical of a place seen from poses, its world turned at random; and its error."""
    R = random_rotation(np.random.default_rng(seed))
    world = turned(np.stack(poses), R)
    chosen = np.unique(np.linspace(0, len(poses) - 1, 12).astype(int))
    seen = [
        block_normals(place.depth(poses[i], CAMERA, seed), CAMERA, world[i, :3, :3]) for i in chosen
    ]
    found = estimated_up(world, seen)
    return found, error(found, R[:, 2])


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("name", sorted(held.CASES))
def test_up_is_found_within_five_degrees_however_the_camera_is_held(name, seed):
    place, poses = held.CASES[name](np.random.default_rng(seed))
    found, off = estimate(place, poses, seed)
    assert off < 5.0
    assert found.within is not None
    assert off <= found.within


def test_cameras_alone_say_up_where_they_turn_round_and_how_little_they_say_where_not():
    R = random_rotation(np.random.default_rng(3))
    draw = np.random.default_rng(4).normal
    round_about = [held_pose([0, 0, 1], a, -10 + 8 * draw(), 3 * draw()) for a in range(0, 360, 15)]
    found = estimated_up(turned(np.stack(round_about), R))
    assert error(found, R[:, 2]) < 3.0
    assert found.within is not None
    assert found.within < 8.0
    one_way = [held_pose([0, 0, 1], 2 * i, -40 + draw(), draw()) for i in range(10)]
    doubtful = estimated_up(turned(np.stack(one_way), R))
    assert doubtful.within is not None
    assert max(15.0, error(doubtful, R[:, 2])) < doubtful.within


def test_a_facade_among_trees_is_not_the_floor():
    """Seen in five public photos of South Building: up was said to be its facade's normal, within
    5 degrees, as leaves in all directions made surfaces count for more than the cameras."""
    rng = np.random.default_rng(0)
    facade = np.array([-0.5, 0.87, 0.0])
    leaves = rng.normal(size=(375, 3))
    leaves /= np.linalg.norm(leaves, axis=1, keepdims=True)
    normals = Normals(
        np.concatenate([np.tile(facade / np.linalg.norm(facade), (125, 1)), leaves]),
        np.ones(500),
        np.full(500, np.radians(1.0)),
    )
    poses = np.stack([held_pose([0, 0, 1], a, 8, rng.normal()) for a in (0, 2, 4, 9, 10)])
    found = estimated_up(poses, [normals])
    assert found.within is not None
    assert error(found, np.array([0.0, 0.0, 1.0])) < min(20.0, found.within)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_an_axis_that_the_evidence_cannot_tell_from_the_estimate_is_up(axis):
    base = np.roll(np.eye(3), axis + 1, axis=0)  # its third column is the axis
    up = base[:, 2]
    draw = np.random.default_rng(1).normal
    poses = [held_pose([0, 0, 1], a, -5, 3 * draw()) for a in range(0, 360, 45)]
    found = estimated_up(turned(np.stack(poses), base))
    np.testing.assert_array_equal(found.direction, up)


def test_up_is_a_direction_for_any_cameras():
    upside_down = np.stack([np.eye(4), np.diag([1.0, -1.0, -1.0, 1.0])])
    for poses in (upside_down, np.eye(4)[None]):
        assert np.linalg.norm(estimated_up(poses).direction) == pytest.approx(1.0)


def test_normals_are_those_of_the_planes_and_only_of_planes():
    place = held.Place(held.room(5, 4, 2.5), noise=2e-4)
    pose = held_pose([2.5, 1.0, 1.4], 20.0, -20.0, 5.0)
    found = block_normals(place.depth(pose, CAMERA, 0), CAMERA, pose[:3, :3])
    assert len(found.weight) > 100
    nearest = np.abs(found.direction).max(axis=1)  # to an axis; some blocks show a corner
    assert (nearest > np.cos(np.radians(5))).mean() > 0.9
    floor = found.direction[:, 2] > 0.99
    assert floor.any()  # towards the camera
    noise = np.random.default_rng(0).uniform(1.0, 3.0, (120, 160)).astype(np.float32)
    assert not len(block_normals(noise, CAMERA, np.eye(3)).weight)
    for empty in (np.zeros((120, 160)), np.full((120, 160), np.inf), np.ones((1, 3))):
        assert not len(block_normals(empty.astype(np.float32), CAMERA, np.eye(3)).weight)
