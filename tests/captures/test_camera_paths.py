"""Camera paths in nerfstudio's layouts: what is written comes back, damaged files are named."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.captures.camera_paths import (
    is_camera_path,
    path_of,
    read_camera_path,
    write_camera_path,
    write_path_transforms,
)
from r3jax.formats.errors import FormatError
from r3jax.formats.nerfstudio import read_transforms
from r3jax.geometry.cameras import Camera
from tests.formats.colmap_models import random_pose

CAMERA = Camera(64, 48, 50.0, 50.0, 32.0, 24.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("paths")


@given(seed=st.integers(0, 10_000))
def test_both_layouts_come_back_exactly(folder, seed):
    poses = np.stack([random_pose(seed + i) for i in range(3)])
    write_path_transforms(folder / "transforms.json", poses, CAMERA)
    images = read_transforms(folder / "transforms.json")
    np.testing.assert_array_equal(images.poses, poses)
    assert images.lenses[0].camera == CAMERA
    write_camera_path(folder / "path.json", poses, CAMERA)
    path = read_camera_path(folder / "path.json")
    np.testing.assert_array_equal(path.poses, poses)
    np.testing.assert_allclose(path.lenses[2].params, (50.0, 50.0, 32.0, 24.0), rtol=1e-6)
    assert (path.lenses[0].width, path.lenses[0].height) == (64, 48)


def test_axes_and_angles_are_nerfstudios(folder):
    """Its renderer: 16 numbers row by row, OpenGL axes, the vertical angle in degrees."""
    pose = np.eye(4)  # OpenCV: looks along +z, y down
    pose[:3, 3] = 1, 2, 3
    write_camera_path(folder / "axes.json", pose[None], CAMERA)
    content = json.loads((folder / "axes.json").read_text())
    (camera,) = content["camera_path"]
    matrix = np.array(camera["camera_to_world"]).reshape(4, 4)
    np.testing.assert_array_equal(matrix[:3, 3], [1, 2, 3])
    np.testing.assert_array_equal(-matrix[:3, 2], [0, 0, 1])  # OpenGL looks along -z
    np.testing.assert_array_equal(matrix[:3, 1], [0, -1, 0])  # and has y up
    focal = 0.5 * content["render_height"] / np.tan(np.radians(camera["fov"]) / 2)
    assert focal == pytest.approx(50.0)
    assert camera["aspect"] == pytest.approx(64 / 48)


@pytest.mark.parametrize("depth", [False, True])
def test_a_path_of_a_training_comes_back_by_its_normalization(tmp_path, depth):
    """By the definition: x_trained = s * (transform @ x), x before applied_transform and scale."""
    applied = np.array([[1.0, 0, 0, 3], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    turn, scale, applied_scale = random_pose(3), 0.07, 0.5
    original = np.stack([random_pose(i) for i in range(4)])
    trained = turn @ original
    trained[:, :3, 3] *= scale
    write_camera_path(tmp_path / "path.json", trained, CAMERA)
    content = {"transform": turn[:3].tolist(), "scale": scale}
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(content))
    in_file = applied @ original
    in_file[:, :3, 3] *= applied_scale
    write_path_transforms(tmp_path / "transforms.json", in_file, CAMERA)
    content = json.loads((tmp_path / "transforms.json").read_text())
    content |= {"applied_transform": applied[:3].tolist(), "applied_scale": applied_scale}
    if depth:
        content["frames"][0]["depth_file_path"] = "depth.png"
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    capture = read_transforms(tmp_path)
    np.testing.assert_allclose(
        path_of(tmp_path / "path.json", capture).poses, capture.poses, rtol=0, atol=1e-9
    )
    np.testing.assert_allclose(path_of(tmp_path / "path.json").poses, original, atol=1e-9)
    bad = {"transform": (2 * turn[:3]).tolist(), "scale": scale}
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(bad))
    with pytest.raises(FormatError, match=r"dataparser_transforms\.json: the transform"):
        path_of(tmp_path / "path.json", capture)


def change(content, **fields):
    return {**content, **fields}


SCALED = np.diag([2.0, 2.0, 2.0, 1.0]).ravel().tolist()

DAMAGES = {
    "no cameras": (lambda c: change(c, camera_path=[]), "holds no cameras"),
    "no size": (lambda c: {**{k: c[k] for k in c if k != "render_width"}}, "render_width"),
    "panorama": (lambda c: change(c, camera_type="equirectangular"), "only perspective paths"),
    "numbers": (lambda c: _first(c, camera_to_world=[1.0] * 12), "must be 16 numbers, got 12"),
    "scale": (lambda c: _first(c, camera_to_world=SCALED), "not rigid"),
    "angle": (lambda c: _first(c, fov=180.0), "fov"),
    "word": (lambda c: _first(c, fov="wide"), "must be float"),
    "image": (lambda c: change(c, render_height=0), "0 pixels|64 x 0"),
}  # fmt: skip


def _first(content, **fields):
    first, *others = content["camera_path"]
    return change(content, camera_path=[{**first, **fields}, *others])


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_path_is_named(folder, damage):
    break_it, message = DAMAGES[damage]
    write_camera_path(folder / "bad.json", np.stack([np.eye(4)] * 2), CAMERA)
    written = json.loads((folder / "bad.json").read_text())
    del written["seal"]  # changed by hand
    (folder / "bad.json").write_text(json.dumps(break_it(written)))
    with pytest.raises(FormatError, match=rf"bad\.json.*({message})"):
        read_camera_path(folder / "bad.json")


def test_other_files_are_no_camera_paths(folder):
    write_camera_path(folder / "good.json", np.eye(4)[None], CAMERA)
    assert is_camera_path(folder / "good.json")
    write_path_transforms(folder / "transforms.json", np.eye(4)[None], CAMERA)
    assert not is_camera_path(folder / "transforms.json")
    (folder / "broken.json").write_text("{")
    assert not is_camera_path(folder / "broken.json")
    assert not is_camera_path(folder)
    assert not is_camera_path(folder / "nowhere.json")
