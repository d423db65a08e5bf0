"""Starts are free, inside and repeatable; bad ones are refused with the reason."""

import numpy as np
import pytest

from r3jax.simulators.clearance import APART, places_beside
from r3jax.simulators.raycast.raycast import RaycastSimulator
from tests.simulators.rooms import SMALL, box_quads, box_room, facing_x, world_of

PILLAR = ((4, 1, 0), (5.5, 3, 3))


def building():
    """A house of 8 x 6 x 3 m with thick walls, a flat roof, a large solid pillar and a table."""
    quads = box_quads((0, 0, 0), (8, 6, 3), inward=True)
    quads += box_quads((-0.5, -0.5, -0.5), (8.5, 6.5, 3.5), inward=False)
    quads += box_quads(*PILLAR, inward=False)
    quads += box_quads((1, 4, 0), (2.5, 5, 0.8), inward=False)
    return world_of(quads)


@pytest.fixture(scope="module")
def house():
    return RaycastSimulator(building(), SMALL)


def test_a_found_start_is_inside_at_eye_height_and_free(house):
    position = house.start_pose[:3, 3]
    assert house.clearance(position[None])[0] >= 1.0
    assert 1.2 <= position[2] <= 1.6
    assert (position[:2] > 0).all()
    assert (position[:2] < [8, 6]).all()
    assert not all(low < x < high for x, low, high in zip(position, *PILLAR, strict=True))


def test_a_found_start_looks_level_and_far(house):
    pose = house.start_pose
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(pose[2, [0, 2]], 0.0, atol=1e-12)  # no roll, no pitch
    depth = np.asarray(house.render(pose).depth)
    assert np.median(np.minimum(depth, 5.0)) > 1.5


def test_the_search_is_seeded():
    poses = [RaycastSimulator(building(), SMALL, seed=seed).start_pose for seed in (0, 0, 1)]
    np.testing.assert_array_equal(poses[0], poses[1])
    assert (poses[0] != poses[2]).any()


@pytest.mark.parametrize("seed", range(5))
def test_no_seed_starts_on_the_roof_or_in_a_wall(seed):
    simulator = RaycastSimulator(building(), SMALL, seed=seed)
    assert simulator.start_pose[2, 3] < 2.5
    assert simulator.clearance(simulator.start_pose[None, :3, 3])[0] >= 0.5


def test_a_room_whose_faces_look_outward_still_has_a_start():
    world = world_of(box_quads((0, 0, 0), (6, 4, 3), inward=False))
    position = RaycastSimulator(world, SMALL).start_pose[:3, 3]
    assert (position > 0.5).all()
    assert (position < [5.5, 3.5, 2.5]).all()


def test_a_scan_without_a_ceiling_still_has_a_start():
    world = world_of(box_quads((0, 0, 0), (6, 4, 3), inward=True)[:-1])
    simulator = RaycastSimulator(world, SMALL)
    assert simulator.clearance(simulator.start_pose[None, :3, 3])[0] >= 0.5


def test_a_mesh_without_free_space_says_so():
    simulator = RaycastSimulator(world_of(box_quads((0, 0, 0), (0.4, 0.4, 0.4), inward=True)))
    with pytest.raises(ValueError, match=r"0\.5 m"):
        _ = simulator.start_pose


def test_a_given_start_is_kept():
    pose = facing_x(2, 2, 1.3)
    np.testing.assert_array_equal(RaycastSimulator(box_room(), start_pose=pose).start_pose, pose)


def test_the_start_of_the_world_is_used():
    world = box_room(start_position=np.array([2.0, 2.0, 1.3]), start_yaw=0.5 * np.pi)
    pose = RaycastSimulator(world).start_pose
    np.testing.assert_allclose(pose[:3, 3], [2.0, 2.0, 1.3])
    np.testing.assert_allclose(pose[:3, 2], [0.0, 1.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("position", "words"),
    [
        ((-0.25, 3.0, 1.5), r"0\.25 m"),  # in the wall
        ((0.1, 3.0, 1.5), r"0\.10 m"),  # in the room, too close
        ((4.7, 2.0, 1.5), "inside a closed solid"),  # deep in the pillar
        ((20.0, 3.0, 1.5), "outside the world"),
    ],
)
def test_a_bad_start_is_refused_with_place_reason_and_advice(position, words):
    with pytest.raises(ValueError, match=words) as caught:
        RaycastSimulator(building(), SMALL, start_pose=facing_x(*position))
    message = str(caught.value)
    assert str(float(position[0])) in message
    assert "for example" in message


def test_a_bad_start_of_the_world_is_refused():
    with pytest.raises(ValueError, match="nearest surface"):
        RaycastSimulator(box_room(start_position=np.array([0.4, 2.0, 1.3])))


def test_a_start_that_is_no_pose_is_refused():
    with pytest.raises(ValueError, match="start_pose"):
        RaycastSimulator(box_room(), start_pose=2.0 * facing_x(2, 2, 1))


def test_places_beside_a_start_keep_apart():
    start = np.array([1.0, -2.0, 1.4])
    places = np.concatenate([start[None], places_beside(start)])
    between = np.linalg.norm(places[:, None] - places[None], axis=2)
    assert between[~np.eye(7, dtype=bool)].min() > APART - 1e-9
    np.testing.assert_allclose(between[0, 1:], APART)
    np.testing.assert_array_equal(places[:, 2], start[2])
