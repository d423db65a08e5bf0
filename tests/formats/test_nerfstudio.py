"""transforms.json: what nerfstudio, instant-ngp, Blender and we write is read as it is meant."""

import copy
import json

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from PIL import Image

from r3jax.formats.errors import FormatError
from r3jax.formats.nerfstudio import OPENGL_FROM_OPENCV, read_transforms, write_transforms
from r3jax.geometry.cameras import invert_pose, project, transform
from r3jax.runs.reader import read_run
from r3jax.runs.writer import RunWriter
from tests.formats.colmap_models import random_pose, seeds
from tests.runs.runs import make_header, make_view

LEVEL = [[1, 0, 0, 1], [0, 0, -1, 2], [0, 1, 0, 3], [0, 0, 0, 1]]
"""An OpenGL camera at (1, 2, 3) that looks along +y with z up: its -z is the world's +y."""

CONTENT = {
    "w": 10,
    "h": 8,
    "fl_x": 12.5,
    "fl_y": 12.25,
    "cx": 5.25,
    "cy": 4,
    "frames": [
        {"file_path": "images/b.png", "transform_matrix": LEVEL},
        {"file_path": "./images/a", "transform_matrix": LEVEL[:3], "fl_x": 20.0, "k1": 0.1},
    ],
}


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "capture"
    (path / "images").mkdir(parents=True)
    for name in ("a.jpg", "b.png"):
        Image.fromarray(np.full((8, 10, 3), 51, np.uint8)).save(path / "images" / name)
    return path


def written(folder, **changes):
    """A transforms.json; None takes a field away, "0.x" and "1.x" are of a frame."""
    content = copy.deepcopy(CONTENT)
    for name, value in changes.items():
        place = content
        if name[0] in "01":
            place, name = content["frames"][int(name[0])], name[2:]
        if value is None:
            del place[name]
        else:
            place[name] = value
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def recorded(folder):
    with RunWriter(folder / "run", make_header()) as writer:
        for step in range(3):
            writer.add(*make_view(step))
    return read_run(folder / "run")


def test_a_run_comes_back_exactly(tmp_path):
    run = recorded(tmp_path)
    images = read_transforms(write_transforms(run, "exports/points.ply"))
    assert images.image_paths == tuple(run.image_path(row.step) for row in run.rows)
    assert images.points_path == run.path / "exports/points.ply"
    np.testing.assert_array_equal(images.poses, np.stack([row.pose for row in run.rows]))
    for theirs, ours in zip(images.frames(), run.frames(), strict=True):
        assert theirs.camera == ours.camera
        np.testing.assert_array_equal(theirs.rgb, ours.rgb)
        np.testing.assert_array_equal(theirs.T_world_camera, ours.T_world_camera)
        measured = np.isfinite(ours.depth)
        np.testing.assert_array_equal(np.isfinite(theirs.depth), measured)
        np.testing.assert_allclose(theirs.depth[measured], ours.depth[measured], rtol=2e-7)


def test_an_opengl_camera_sees_the_same_pixels(tmp_path):
    run = recorded(tmp_path)
    content = json.loads(write_transforms(run).read_text())
    rng = np.random.default_rng(0)
    points = rng.uniform(-3.0, 3.0, (50, 3)).astype(np.float32)
    for row, frame in zip(run.rows, content["frames"], strict=True):
        ours, depth = project(
            run.camera, transform(invert_pose(jnp.asarray(row.pose)), jnp.asarray(points))
        )
        world_from_gl = np.asarray(frame["transform_matrix"])
        x, y, z = ((points - world_from_gl[:3, 3]) @ world_from_gl[:3, :3]).T
        u = content["fl_x"] * x / -z + content["cx"]
        v = content["fl_y"] * -y / -z + content["cy"]
        front = np.asarray(depth) > 0.1
        assert front.any()
        np.testing.assert_allclose(np.stack([u, v], 1)[front], ours[front], rtol=1e-3, atol=1e-2)


@given(seed=seeds)
def test_any_pose_comes_back(tmp_path_factory, seed):
    folder = tmp_path_factory.mktemp("poses")
    pose = random_pose(seed)
    written(folder, **{"0.transform_matrix": (pose @ OPENGL_FROM_OPENCV).tolist()})
    np.testing.assert_allclose(read_transforms(folder).poses[0], pose, atol=1e-12)


def test_axes_by_the_documentation(folder):
    """+X right, +Y up, -Z the look-at direction; the world's z is up."""
    pose = read_transforms(written(folder)).poses[0]
    right, down, forward, position = pose[:3].T
    np.testing.assert_array_equal(right, [1, 0, 0])
    np.testing.assert_array_equal(down, [0, 0, -1])
    np.testing.assert_array_equal(forward, [0, 1, 0])
    np.testing.assert_array_equal(position, [1, 2, 3])


def test_the_order_of_the_file_names_without_suffix_and_a_frames_own_camera(folder):
    images = read_transforms(written(folder))
    assert [path.name for path in images.image_paths] == ["b.png", "a.jpg"]
    first, second = images.lenses
    assert (first.model, first.params) == ("PINHOLE", (12.5, 12.25, 5.25, 4.0))
    assert (second.model, second.intrinsics[0]) == ("OPENCV", 20.0)
    assert second.distortion == {"k1": 0.1, "k2": 0.0, "p1": 0.0, "p2": 0.0}
    assert first.is_pinhole
    assert not second.is_pinhole


@pytest.mark.parametrize(
    ("changes", "model", "distortion"),
    [
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k4": 0.4}, "OPENCV_FISHEYE", (0.1, 0.4)),
        ({"camera_model": "PINHOLE"}, "PINHOLE", ()),
        ({"camera_model": "SIMPLE_PINHOLE"}, "PINHOLE", ()),
        ({"is_fisheye": True, "k2": 0.2}, "OPENCV_FISHEYE", (0.2,)),
        ({"k3": 0.3}, "FULL_OPENCV", (0.3,)),
        ({"camera_model": "OPENCV", "p1": 0.5, "p2": 0.6}, "OPENCV", (0.5, 0.6)),
    ],
)
def test_camera_models(folder, changes, model, distortion):
    lens = read_transforms(written(folder, **changes)).lenses[0]
    assert lens.model == model
    assert tuple(value for value in lens.distortion.values() if value) == distortion
    assert lens.intrinsics == (12.5, 12.25, 5.25, 4.0)


def test_blenders_angle_of_view_and_a_size_asked_of_the_image(folder):
    none = dict.fromkeys(("w", "h", "fl_x", "fl_y", "cx", "cy", "1.fl_x", "1.k1"))
    images = read_transforms(written(folder, camera_angle_x=np.pi / 2, **none))
    for lens in images.lenses:
        np.testing.assert_allclose(lens.intrinsics, (5.0, 5.0, 5.0, 4.0))
        assert (lens.width, lens.height) == (10, 8)


def test_applied_transform_is_kept_and_poses_stay_in_the_files_coordinates(folder):
    rows = [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]]
    images = read_transforms(written(folder, applied_transform=rows, applied_scale=0.5))
    np.testing.assert_array_equal(images.poses, read_transforms(written(folder)).poses)
    moved = images.T_capture_original
    assert moved is not None
    np.testing.assert_array_equal(moved @ [2, 4, 6, 1], [1, 3, -2, 1])
    assert read_transforms(written(folder)).T_capture_original is None
    assert "depth" in images.remark


def test_an_applied_scale_is_undone_where_depth_tells_the_units(folder):
    rows = [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]]
    depth = {"0.depth_file_path": "depth.png", "ply_file_path": "points.ply"}
    images = read_transforms(written(folder, applied_transform=rows, applied_scale=0.5, **depth))
    metric = read_transforms(written(folder)).poses
    np.testing.assert_array_equal(images.poses[:, :3, 3], 2 * metric[:, :3, 3])
    np.testing.assert_array_equal(images.poses[:, :3, :3], metric[:, :3, :3])
    np.testing.assert_array_equal(images.T_capture_original @ [2, 4, 6, 1], [2, 6, -4, 1])
    assert images.points_path is None
    assert "0.5 (applied_scale)" in images.remark


def test_depth_is_in_millimeters_unless_the_file_says_otherwise(folder):
    steps = np.arange(20, dtype=np.uint16).reshape(4, 5)  # half the image's size
    Image.fromarray(steps).save(folder / "depth.png")
    images = read_transforms(written(folder, **{"0.depth_file_path": "depth.png"}))
    frame = images.frame(0)
    np.testing.assert_allclose(frame.depth, np.kron(steps, np.ones((2, 2))) / 1000, rtol=1e-6)
    np.testing.assert_allclose(frame.rgb, 0.2)
    scaled = written(
        folder,
        depth_unit_scale_factor=0.5,
        depth_beyond_range_value=19,
        **{"0.depth_file_path": "depth.png"},
    )
    depth = np.asarray(read_transforms(scaled).frame(0).depth)
    assert depth[0, 2] == 0.5
    assert np.isinf(depth[-1, -1])
    with pytest.raises(FormatError, match="distorted"):
        images.frame(1)


def test_what_is_missing_is_named_when_it_is_read(folder):
    images = read_transforms(written(folder, **{"0.depth_file_path": "gone.png", "1.k1": 0}))
    with pytest.raises(FormatError, match=r"gone\.png"):
        images.frame(0)
    with pytest.raises(FormatError, match=r"a\.jpg.*depth"):
        images.frame(1)
    (folder / "images" / "b.png").unlink()
    assert len(read_transforms(folder)) == 2
    with pytest.raises(FormatError, match=r"b\.png"):
        images.frame(0)


def test_masks_are_those_that_are_named_or_lie_in_their_folder(folder):
    (folder / "masks").mkdir()
    mask = np.zeros((8, 10), np.uint8)
    mask[:, :5] = 255
    for name in ("masks/b.png", "own.png"):
        Image.fromarray(mask).save(folder / name)
    found = read_transforms(written(folder))
    assert found.mask_paths == (folder / "masks" / "b.png", None)
    is_there = found.masked_rgb(0)[1]
    assert is_there is not None
    np.testing.assert_array_equal(is_there, mask > 0)
    named = read_transforms(written(folder, **{"0.mask_path": "own.png"}))
    assert named.mask_paths == (folder / "own.png", None)
    gone = read_transforms(written(folder, **{"0.mask_path": "gone.png"}))
    assert gone.mask_paths is None
    assert gone.remark is not None
    assert "gone.png" in gone.remark
