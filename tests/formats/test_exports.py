"""Exports: an exported camera that comes back sees the same pixels."""

import dataclasses
import json
import shutil

import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.cli.main import USER_ERROR, main
from r3jax.exploration.config import BEYOND_RANGE, DEPTH_STEPS_PER_METRE
from r3jax.exploration.taken_views import frame_hash, stored_form
from r3jax.formats.colmap.reader import read_colmap
from r3jax.formats.depth import DepthUnit
from r3jax.formats.exports import export_run
from r3jax.formats.nerfstudio import read_transforms
from r3jax.formats.points import read_points
from r3jax.geometry.cameras import Camera, look_at
from r3jax.mapping.occupancy import empty_grid
from r3jax.mapping.state import empty_map
from r3jax.mapping.update import integrate_points
from r3jax.runs.header import camera_fields
from r3jax.runs.reader import read_run
from r3jax.runs.stored_states import map_tables
from r3jax.runs.writer import RunWriter
from r3jax.simulators.meshes import load_world
from r3jax.simulators.raycast.raycast import RaycastSimulator
from tests.box_room import write_room
from tests.runs.runs import make_header, make_view

CAMERA = Camera(40, 30, 31.3, 30.7, 21.1, 14.2)
"""Nothing about it is symmetric."""

POSES = [
    np.asarray(look_at(np.array([-1.5, -1.0, 0.3]), np.array(target)))
    for target in ([1.2, 0.6, -0.4], [-2.0, 1.5, 0.2], [-1.6, -1.4, -1.2])
]
KINDS = ["nerfstudio", "colmap", "colmap-text"]


def read_back(path, kind):
    return read_transforms(path) if kind == "nerfstudio" else read_colmap(path)


@pytest.fixture(scope="module")
def simulator(tmp_path_factory):
    room = write_room(tmp_path_factory.mktemp("mesh") / "room.ply")
    return RaycastSimulator(load_world(room.removeprefix("mesh:")), CAMERA, max_range=None)


@pytest.fixture(scope="module")
def run(simulator, tmp_path_factory):
    """Three views of the room, and a map with two voxels."""
    path = tmp_path_factory.mktemp("runs") / "run"
    points = jnp.asarray([[0.11, 0.52, 1.03], [-0.31, 0.22, 0.47]])
    colors = jnp.asarray([[1.0, 0.0, 0.2], [0.4, 0.6, 0.8]])
    state = integrate_points(empty_map(64, voxel_size=0.1), points, colors, jnp.ones(3))
    with RunWriter(path, make_header(camera=camera_fields(CAMERA))) as writer:
        for step, pose in enumerate(POSES):
            frame = stored_form(simulator.render(pose))
            row = dataclasses.replace(
                make_view(step)[0], pose=np.asarray(frame.T_world_camera), sha256=frame_hash(frame)
            )
            writer.add(row, frame)
        grid = empty_grid(np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]), 0.5)
        writer.checkpoint(2, map_tables(state, grid), wait=True)
        writer.finish("done", "")
    return read_run(path)


def render_again(simulator, images, index):
    """What a simulator sees from an exported camera, given nothing but what was read."""
    lens = images.lenses[index]
    assert lens.is_pinhole
    camera = lens.camera
    return simulator.with_camera(camera, max_range=None).render(images.poses[index])


def assert_same_pixels(again, first):
    """To the last bits of a pose: a ray on an edge may fall to the other side."""
    difference = np.abs(np.asarray(again.rgb) - np.asarray(first.rgb)).max(axis=-1)
    assert np.mean(difference > 1e-3) < 0.005
    deviation = np.abs(np.asarray(again.depth) - np.asarray(first.depth))
    assert np.mean(deviation > 1e-4) < 0.005


@pytest.mark.parametrize("kind", KINDS)
def test_an_exported_camera_sees_the_same_pixels(run, simulator, tmp_path, kind):
    export_run(run, tmp_path / "out", kind)
    images = read_back(tmp_path / "out", kind)
    assert len(images) == len(POSES)
    for index, row in enumerate(run.rows):
        np.testing.assert_allclose(images.poses[index], row.pose, atol=1e-6)
        first = simulator.render(row.pose)
        assert np.asarray(first.rgb).std() > 0.05  # there is something to see
        assert_same_pixels(render_again(simulator, images, index), first)
        assert images.image_paths[index].read_bytes() == run.image_path(row.step).read_bytes()


@pytest.mark.parametrize("kind", KINDS)
def test_the_folder_needs_the_run_no_longer(run, tmp_path, kind):
    copy = shutil.copytree(run.path, tmp_path / "copy")
    assert export_run(read_run(copy), tmp_path / "out", kind) == 2
    shutil.rmtree(copy)
    out = (tmp_path / "out").rename(tmp_path / "moved")
    images = read_back(out, kind)
    for path in images.image_paths:
        assert path.is_file()
        assert path.is_relative_to(out)
        assert not path.is_symlink()
        assert (out / "depth" / path.name).is_file()
    assert not [path for path in tmp_path.rglob("*") if path.name.endswith(".partial")]


@pytest.mark.parametrize("kind", KINDS)
def test_frames_come_back(run, tmp_path, kind):
    export_run(run, tmp_path / "out", kind)
    images = read_back(tmp_path / "out", kind)
    if kind == "nerfstudio":
        assert images.points_path is not None
        assert len(read_points(images.points_path)[0]) == 2
    else:
        unit = DepthUnit(1.0 / DEPTH_STEPS_PER_METRE, BEYOND_RANGE)
        images = images.with_depth(tmp_path / "out" / "depth", unit)
    for again, first in zip(images.frames(), run.frames(), strict=True):
        assert again.camera == first.camera
        np.testing.assert_array_equal(again.rgb, first.rgb)
        np.testing.assert_allclose(again.T_world_camera, first.T_world_camera, atol=1e-6)
        np.testing.assert_allclose(again.depth, first.depth, rtol=2e-7)


def test_images_without_a_depth_image_have_none(run, tmp_path):
    export_run(run, tmp_path / "out", "colmap")
    (tmp_path / "out" / "depth" / "000001.png").unlink()
    images = read_colmap(tmp_path / "out").with_depth(tmp_path / "out" / "depth", DepthUnit())
    assert [path is None for path in images.depth_paths] == [False, True, False]


DOCUMENTED = {
    *("camera_model", "fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "k4", "p1", "p2"),
    *("frames", "ply_file_path", "applied_transform"),
}
"""Fields of https://docs.nerf.studio/quickstart/data_conventions.html."""

OURS = {"depth_unit_scale_factor", "depth_beyond_range_value"}
"""Others read on when they meet these."""


def test_the_file_holds_the_documented_fields(run, tmp_path):
    export_run(run, tmp_path / "out", "nerfstudio")
    content = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert content.keys() <= DOCUMENTED | OURS
    assert content.keys() >= {"fl_x", "fl_y", "cx", "cy", "w", "h", "frames", "ply_file_path"}
    assert content["camera_model"] == "OPENCV"
    for frame in content["frames"]:
        assert frame.keys() == {"file_path", "depth_file_path", "transform_matrix"}
        assert np.shape(frame["transform_matrix"]) == (4, 4)


@pytest.mark.parametrize("kind", ["colmap", "colmap-text"])
def test_voxels_become_points(run, tmp_path, kind):
    export_run(run, tmp_path / "out", kind)
    points = read_colmap(tmp_path / "out").points
    assert points is not None
    order = np.argsort(-points.xyz[:, 0])
    expected = [[0.15, 0.55, 1.05], [-0.35, 0.25, 0.45]]
    np.testing.assert_allclose(points.xyz[order], expected, atol=1e-6)
    np.testing.assert_array_equal(points.rgb[order], [[255, 0, 51], [102, 153, 204]])


@pytest.mark.parametrize("kind", KINDS)
def test_the_command_exports(run, tmp_path, capsys, kind):
    out = tmp_path / "deep" / "out"
    assert main(["export", str(run.path), "--format", kind, "--out", str(out)]) == 0
    assert "3 images, 2 points" in capsys.readouterr().err
    assert len(read_back(out, kind)) == 3
    assert main(["export", str(run.path), "--format", kind, "--out", str(out)]) == USER_ERROR
    assert "something is there already" in capsys.readouterr().err


def test_what_cannot_be_exported_is_said_in_a_line(run, tmp_path, capsys):
    copy = shutil.copytree(run.path, tmp_path / "copy")
    (copy / "frames" / "000001.png").unlink()
    words = ["--out", str(tmp_path / "out")]
    assert main(["export", str(tmp_path / "nowhere"), *words]) == USER_ERROR
    assert main(["export", str(copy), *words]) == USER_ERROR
    (copy / "trace.jsonl").write_text("")
    assert main(["export", str(copy), *words]) == USER_ERROR
    said = capsys.readouterr().err.splitlines()
    lines = [line for line in said if line.startswith("r3jax: ")]
    for line, words in zip(lines, ("no such folder", "000001.png", "no views"), strict=True):
        assert words in line
    assert not (tmp_path / "out").exists()


def test_a_run_without_a_map_has_no_points(run, tmp_path):
    copy = shutil.copytree(run.path, tmp_path / "copy")
    shutil.rmtree(copy / "checkpoints")
    assert export_run(read_run(copy), tmp_path / "out", "nerfstudio") == 0
    content = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert "ply_file_path" not in content
    assert export_run(read_run(copy), tmp_path / "model", "colmap") == 0
    assert len(read_colmap(tmp_path / "model")) == 3
