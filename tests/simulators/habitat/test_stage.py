"""Stages, poses, axes and fields of view against what a real Habitat-Sim said of them."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from r3jax.errors import InputError
from r3jax.geometry.cameras import Camera
from r3jax.simulators import meshes
from r3jax.simulators.habitat import (
    BARE_GLB,
    agent_from_pose,
    habitat_from_axes,
    horizontal_fov_deg,
    read_stage,
)
from tests.simulators.habitat.habitat_golden import load_house, load_simple_room

SCENES = [load_house, load_simple_room]
STAGES = [((0, 1, 0), (0, 0, -1)), ((0, 0, 1), (0, 1, 0)), ((0, 0, 1), (-1, 0, 0))]


def random_pose(seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=random).as_matrix()
    pose[:3, 3] = random.uniform(-20.0, 20.0, 3)
    return pose


@pytest.mark.parametrize("load", SCENES)
def test_habitat_said_so(load, shared):
    golden = load(shared)
    frames = golden.frames
    for i, pose in enumerate(golden.poses):
        position, rotation = agent_from_pose(pose, golden.habitat_from_world)
        wxyz = rotation.as_quat(scalar_first=True)
        for who in ("agent", "sensor"):
            np.testing.assert_allclose(position, frames[f"{who}_position"][i], atol=1e-6)
            expected = frames[f"{who}_rotation_wxyz"][i]  # equal up to the sign
            np.testing.assert_allclose(wxyz * np.sign(np.dot(wxyz, expected)), expected, atol=1e-6)
    np.testing.assert_allclose(BARE_GLB, frames["habitat_from_glb"][:3, :3], atol=1e-12)
    assert horizontal_fov_deg(golden.camera) == pytest.approx(float(frames["hfov_deg"]), abs=1e-4)
    found = meshes.world_from_file(golden.mesh, golden.up)
    np.testing.assert_allclose(found, golden.world_from_file, atol=1e-12)


@pytest.mark.parametrize(("up", "front"), STAGES)
def test_a_stage_becomes_y_up_and_is_not_mirrored(up, front):
    rotation = habitat_from_axes(up, front)
    np.testing.assert_allclose(rotation @ up, [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(rotation @ front, [0, 0, -1], atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_the_field_of_view_is_that_of_the_width():
    wide = horizontal_fov_deg(Camera.from_fov(640, 480, 90.0))
    assert wide == pytest.approx(90.0, abs=1e-4)


def assert_agent_is_at(pose: np.ndarray, turn: np.ndarray) -> None:
    position, rotation = agent_from_pose(pose, turn)
    axes = rotation.as_matrix()
    np.testing.assert_allclose(axes, turn @ pose[:3, :3] @ np.diag([1.0, -1.0, -1.0]), atol=1e-9)
    np.testing.assert_allclose(position, turn @ pose[:3, 3], atol=1e-9)


@given(st.integers(0, 1 << 30), st.sampled_from(STAGES))
def test_the_agent_is_where_the_camera_is(seed, stage):
    assert_agent_is_at(random_pose(seed), habitat_from_axes(*stage))


@pytest.mark.parametrize("axis", [*np.eye(3).tolist(), [0.6, 0.0, 0.8], [-0.6, 0.8, 0.0]])
def test_half_turns(axis):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(np.pi * np.array(axis)).as_matrix()
    assert_agent_is_at(pose, np.eye(3))


def test_a_pose_that_is_rigid_up_to_rounding_becomes_a_rotation():
    pose = random_pose(3)
    _, rounded = agent_from_pose(pose.astype(np.float16).astype(np.float64), np.eye(3))
    _, exact = agent_from_pose(pose, np.eye(3))
    assert (rounded * exact.inv()).magnitude() < 1e-3


def test_a_pose_that_mirrors_is_refused():
    with pytest.raises(ValueError, match="mirrors"):
        agent_from_pose(np.diag([1.0, 1, -1, 1]), np.eye(3))


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
        habitat_from_axes(up, front)


def test_axes_of_two_numbers():
    with pytest.raises(ValueError, match="3 numbers"):
        habitat_from_axes((0, 1), (0, 0, -1))


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
        horizontal_fov_deg(Camera(64, 48, *lens))


Z_UP = {"up": [0, 0, 1], "front": [0, 1, 0]}
Y_UP = {"up": [0, 1, 0], "front": [0, 0, -1]}
TURN = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


@pytest.fixture
def config(tmp_path):
    """Writes a stage config into `habitat/`, beside a mesh, as Replica has them."""
    (tmp_path / "mesh.ply").write_bytes(b"ply")
    (tmp_path / "mesh.glb").write_bytes(b"glb")
    (tmp_path / "habitat").mkdir()

    def write(text):
        path = tmp_path / "habitat" / "a.stage_config.json"
        path.write_text(text if isinstance(text, str) else json.dumps(text))
        return path

    return write


@pytest.mark.parametrize(("name", "turn"), [("a.glb", TURN), ("a.GLB", TURN), ("a.ply", np.eye(3))])
def test_bare_meshes_as_measured(tmp_path, name, turn):
    (tmp_path / name).write_bytes(b"mesh")
    stage = read_stage(tmp_path / name)
    assert stage.file == stage.mesh == tmp_path / name
    np.testing.assert_array_equal(stage.habitat_from_file, turn)


@pytest.mark.parametrize(("axes", "turn"), [(Z_UP, TURN), (Y_UP, np.eye(3))])
def test_a_stage_config_says_its_axes(config, tmp_path, axes, turn):
    more = {"scale": [1.0, 1.0, 1.0], "units_to_meters": 1, "semantic_asset": "mesh_semantic.ply"}
    path = config({"render_asset": "../mesh.glb", **axes, **more})
    stage = read_stage(path)
    assert stage.file == path
    assert stage.mesh.resolve() == tmp_path / "mesh.glb"
    np.testing.assert_array_equal(stage.habitat_from_file, turn)


@pytest.mark.parametrize("axes", [Z_UP, Y_UP, {}, {"up": [0, 0, 1], "front": [0, 0, 1]}])
def test_a_ply_is_never_turned_whatever_its_config_says(config, axes):
    """Measured on the real one: four configs, all 24 rotations, the identity each time."""
    stage = read_stage(config({"render_asset": "../mesh.ply", **axes}))
    assert stage.is_ply
    np.testing.assert_array_equal(stage.habitat_from_file, np.eye(3))


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({**Z_UP}, "render_asset"),
        ({"render_asset": 3, **Z_UP}, "render_asset"),
        ({"render_asset": "no.ply", **Z_UP}, r"render_asset .*no\.ply"),
        ({"render_asset": "..", **Z_UP}, "this is a folder"),
        ({"render_asset": "../mesh.glb"}, "up and front"),
        ({"render_asset": "../mesh.glb", "up": [0, 0, 1]}, "front"),
        ({"render_asset": "../mesh.glb", "up": "z", "front": [0, 1, 0]}, "up"),
        ({"render_asset": "../mesh.glb", "up": [0, 0, 1], "front": [0, 0, 1]}, "right angles"),
        ({"render_asset": "../mesh.glb", "up": [0, 1], "front": [0, 0, 1]}, "3 numbers"),
        ({"render_asset": "../mesh.glb", **Z_UP, "scale": [2, 2, 2]}, "scale"),
        ({"render_asset": "../mesh.glb", **Z_UP, "origin": [1, 0, 0]}, "origin"),
        (["render_asset"], "stage config"),
        ("{", "not JSON"),
    ],
)
def test_configs_that_cannot_be_followed(config, fields, reason):
    path = config(fields)
    with pytest.raises(ValueError, match=reason) as caught:
        read_stage(path)
    assert str(path) in str(caught.value)


def test_other_files(tmp_path):
    (tmp_path / "a.obj").write_bytes(b"mesh")
    with pytest.raises(ValueError, match=r"a\.obj.*\.glb"):
        read_stage(tmp_path / "a.obj")
    with pytest.raises(ValueError, match=r"b\.glb"):
        read_stage(tmp_path / "b.glb")
    with pytest.raises(ValueError, match=r"b\.stage_config\.json"):
        read_stage(tmp_path / "b.stage_config.json")
    (tmp_path / "c.ply").mkdir()
    with pytest.raises(InputError):
        read_stage(tmp_path / "c.ply")
