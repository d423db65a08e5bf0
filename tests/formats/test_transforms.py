"""transforms.json: nerfstudio's camera sees the world where ours does."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.formats.nerfstudio import OPENGL_FROM_OPENCV, write_transforms
from r3jax.formats.points import voxel_points, write_points
from r3jax.geometry.cameras import invert_pose, project, transform
from r3jax.mapping.state import empty_map
from r3jax.mapping.update import integrate_points
from r3jax.runs.reader import read_run
from r3jax.runs.writer import RunWriter
from tests.runs.runs import make_header, make_view


@pytest.fixture
def run(tmp_path):
    with RunWriter(tmp_path / "run", make_header()) as writer:
        for step in range(3):
            writer.add(*make_view(step))
    return read_run(tmp_path / "run")


def test_an_opengl_camera_sees_the_same_pixels(run):
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


def test_every_file_it_names_exists_and_depth_is_metric(run):
    from PIL import Image

    content = json.loads(write_transforms(run, points=None).read_text())
    for step, frame in enumerate(content["frames"]):
        assert (run.path / frame["file_path"]).exists()
        steps = np.asarray(Image.open(run.path / frame["depth_file_path"]))
        metres = steps * content["depth_unit_scale_factor"]
        stored = np.asarray(run.frame(step).depth)
        measured = np.isfinite(stored)
        np.testing.assert_allclose(metres[measured], stored[measured], rtol=1e-6)
        assert np.all(steps[~measured] == content["depth_beyond_range_value"])


def test_the_axes_change_is_its_own_inverse():
    np.testing.assert_array_equal(OPENGL_FROM_OPENCV @ OPENGL_FROM_OPENCV, np.eye(4))


def test_voxels_become_points_where_they_are(tmp_path):
    import trimesh

    points = jnp.asarray([[0.11, 0.52, 1.03], [-0.31, 0.22, 0.47]])
    colors = jnp.asarray([[1.0, 0.0, 0.2], [0.4, 0.6, 0.8]])
    state = integrate_points(empty_map(64, voxel_size=0.1), points, colors, jnp.ones(3))
    write_points(tmp_path / "points.ply", *voxel_points(state))
    cloud = trimesh.load(tmp_path / "points.ply")
    order = np.argsort(-cloud.vertices[:, 0])
    np.testing.assert_allclose(
        cloud.vertices[order], [[0.15, 0.55, 1.05], [-0.35, 0.25, 0.45]], atol=1e-6
    )
    np.testing.assert_array_equal(cloud.colors[order, :3], [[255, 0, 51], [102, 153, 204]])


def test_points_and_colors_must_fit(tmp_path):
    with pytest.raises(ValueError, match=r"both be \[n, 3\]"):
        write_points(tmp_path / "p.ply", np.zeros((2, 3)), np.zeros((3, 3), np.uint8))
