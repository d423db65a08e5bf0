"""Poses, axes and fields of view against what a real Habitat-Sim said of them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from r3jax.geometry.cameras import Camera
from r3jax.simulators import meshes
from r3jax.simulators.habitat import habitat_poses
from tests.conftest import shared_path
from tests.mutants import Modules, Mutant, assert_caught, each
from tests.simulators.habitat.habitat_golden import load_house, load_simple_room

SCENES = [load_house, load_simple_room]
STAGES = [((0, 1, 0), (0, 0, -1)), ((0, 0, 1), (0, 1, 0)), ((0, 0, 1), (-1, 0, 0))]


def random_pose(seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=random).as_matrix()
    pose[:3, 3] = random.uniform(-20.0, 20.0, 3)
    return pose


def same_rotation(found: np.ndarray, expected: np.ndarray) -> None:
    """Quaternions are equal up to their sign."""
    np.testing.assert_allclose(found * np.sign(np.dot(found, expected)), expected, atol=1e-6)


def law_states(modules: Modules) -> None:
    """Our poses become the agent's and the sensor's recorded states."""
    for load in SCENES:
        golden = load(shared_path)
        for i, pose in enumerate(golden.poses):
            position, wxyz = modules["habitat_poses"].agent_from_pose(
                pose, golden.habitat_from_world
            )
            for who in ("agent", "sensor"):
                expected = golden.frames[f"{who}_position"][i]
                np.testing.assert_allclose(position, expected, atol=1e-6)
                same_rotation(wxyz, golden.frames[f"{who}_rotation_wxyz"][i])


def law_poses(modules: Modules) -> None:
    """The recorded states become our poses."""
    for load in SCENES:
        golden = load(shared_path)
        for i, pose in enumerate(golden.poses):
            position = golden.frames["agent_position"][i]
            wxyz = golden.frames["agent_rotation_wxyz"][i]
            found = modules["habitat_poses"].pose_from_agent(
                position, wxyz, golden.habitat_from_world
            )
            np.testing.assert_allclose(found, pose, atol=1e-6)


def law_bare_glb(modules: Modules) -> None:
    """A bare GLB is turned as Habitat turned it."""
    for load in SCENES:
        expected = load(shared_path).frames["habitat_from_glb"][:3, :3]
        np.testing.assert_allclose(modules["habitat_poses"].BARE_GLB, expected, atol=1e-12)


def law_stages(modules: Modules) -> None:
    """A stage's up becomes +y and its front -z, by a rotation that mirrors nothing."""
    for up, front in STAGES:
        rotation = modules["habitat_poses"].habitat_from_axes(up, front)
        np.testing.assert_allclose(rotation @ up, [0, 1, 0], atol=1e-12)
        np.testing.assert_allclose(rotation @ front, [0, 0, -1], atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1.0)


def law_field_of_view(modules: Modules) -> None:
    for load in SCENES:
        golden = load(shared_path)
        found = modules["habitat_poses"].horizontal_fov_deg(golden.camera)
        assert found == pytest.approx(float(golden.frames["hfov_deg"]), abs=1e-4)
    wide = modules["habitat_poses"].horizontal_fov_deg(Camera.from_fov(640, 480, 90.0))
    assert wide == pytest.approx(90.0, abs=1e-4)


LAWS = [law_states, law_poses, law_bare_glb, law_stages, law_field_of_view]
MUTANTS = [
    Mutant("habitat_poses", "np.diag([1.0, -1.0, -1.0])", "np.diag([1.0, 1.0, 1.0])", law_states),
    Mutant("habitat_poses", "np.diag([1.0, -1.0, -1.0])", "np.diag([-1.0, 1.0, -1.0])", law_poses),
    Mutant(
        "habitat_poses",
        "T[:3, 3], _wxyz_of(rotation)",
        "T[:3, 3], np.roll(_wxyz_of(rotation), -1)",  # x, y, z, w
        law_states,
    ),
    Mutant(
        "habitat_poses",
        "w, *axis = np.asarray(wxyz, np.float64)",
        "*axis, w = np.asarray(wxyz, np.float64)",
        law_poses,
    ),
    Mutant(
        "habitat_poses", "turn = rotation.T - rotation", "turn = rotation - rotation.T", law_states
    ),
    Mutant("habitat_poses", "= habitat_from_world.T @ np", "= habitat_from_world @ np", law_poses),
    Mutant(
        "habitat_poses", "_axes((0, 0, 1), (0, 1, 0))", "_axes((0, 1, 0), (0, 0, -1))", law_bare_glb
    ),
    Mutant(
        "habitat_poses", "_axes((0, 0, 1), (0, 1, 0))", "_axes((0, 0, 1), (0, -1, 0))", law_bare_glb
    ),
    Mutant("habitat_poses", "np.cross(y, z)", "np.cross(z, y)", law_stages),
    Mutant("habitat_poses", "-np.asarray(front", "np.asarray(front", law_stages),
    Mutant(
        "habitat_poses", "0.5 * camera.width / fx", "0.5 * camera.height / fx", law_field_of_view
    ),
]


@pytest.mark.parametrize("law", LAWS)
def test_habitat_said_so(law):
    law({"habitat_poses": habitat_poses})


@each(MUTANTS)
def test_faults_are_noticed(mutant):
    assert_caught(("r3jax.simulators.habitat.habitat_poses",), mutant)


@pytest.mark.parametrize("load", SCENES)
def test_our_world_is_that_of_mesh_scenes(load, shared):
    golden = load(shared)
    found = meshes.world_from_file(golden.mesh, golden.up)
    np.testing.assert_allclose(found, golden.world_from_file, atol=1e-12)


@given(st.integers(0, 1 << 30), st.sampled_from(STAGES))
def test_there_and_back(seed, stage):
    pose, turn = random_pose(seed), habitat_poses.habitat_from_axes(*stage)
    position, wxyz = habitat_poses.agent_from_pose(pose, turn)
    assert wxyz[0] >= 0.0
    assert np.linalg.norm(wxyz) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(habitat_poses.pose_from_agent(position, wxyz, turn), pose, atol=1e-9)


@given(st.integers(0, 1 << 30))
def test_quaternions_are_those_of_scipy(seed):
    expected = Rotation.from_matrix(random_pose(seed)[:3, :3])
    x, y, z, w = expected.as_quat()
    found = habitat_poses.rotation_of(np.array([w, x, y, z]))
    np.testing.assert_allclose(found, expected.as_matrix(), atol=1e-12)


@pytest.mark.parametrize("axis", [*np.eye(3).tolist(), [0.6, 0.0, 0.8], [-0.6, 0.8, 0.0]])
def test_half_turns(axis):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(np.pi * np.array(axis)).as_matrix()
    position, wxyz = habitat_poses.agent_from_pose(pose, np.eye(3))
    found = habitat_poses.pose_from_agent(position, wxyz, np.eye(3))
    np.testing.assert_allclose(found, pose, atol=1e-9)


def test_a_pose_that_is_rigid_up_to_rounding_becomes_a_rotation():
    pose = random_pose(3)
    rounded = pose.astype(np.float16).astype(np.float64)
    _, wxyz = habitat_poses.agent_from_pose(rounded, np.eye(3))
    assert np.linalg.norm(wxyz) == pytest.approx(1.0, abs=1e-12)
    _, exact = habitat_poses.agent_from_pose(pose, np.eye(3))
    np.testing.assert_allclose(wxyz, exact, atol=1e-3)


def test_a_pose_that_mirrors_is_refused():
    with pytest.raises(ValueError, match="mirrors"):
        habitat_poses.agent_from_pose(np.diag([1.0, 1, -1, 1]), np.eye(3))


@pytest.mark.parametrize(
    ("up", "front"),
    [
        ((0, 1, 0), (0, 1, 0)),
        ((0, 2, 0), (0, 0, -1)),
        ((0, 0, 0), (0, 0, -1)),
        ((0, 1e308, 0), (1e308, 0, 1)),
    ],
)
def test_axes_that_are_none(up, front):
    with pytest.raises(ValueError, match="right angles"):
        habitat_poses.habitat_from_axes(up, front)


def test_axes_of_two_numbers():
    with pytest.raises(ValueError, match="3 numbers"):
        habitat_poses.habitat_from_axes((0, 1), (0, 0, -1))


@pytest.mark.parametrize(
    ("lens", "reason"),
    [
        ((60.0, 61.0, 32.0, 24.0), "square pixels"),
        ((60.0, 60.0, 31.5, 24.0), "principal point"),
        ((60.0, 60.0, 32.0, 24.5), "principal point"),
    ],
)
def test_cameras_that_habitat_does_not_have(lens, reason):
    with pytest.raises(ValueError, match=reason):
        habitat_poses.horizontal_fov_deg(Camera(64, 48, *lens))
