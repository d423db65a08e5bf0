"""Thinned and straightened images: against COLMAP's own library, and what must not move.

Sparse depth from points: each where the camera shows it, and nothing that is hidden.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from r3jax.captures.source import (
    Source,
    distorted,
    sampling_table,
    source_of,
    sparse_depth,
    thinned,
)
from r3jax.formats.colmap.reader import read_colmap
from r3jax.formats.errors import FormatError
from r3jax.formats.lenses import MODELS, Lens
from r3jax.formats.nerfstudio import read_transforms
from r3jax.formats.points import write_points
from r3jax.geometry.cameras import Camera
from r3jax.validation.errors import ForeignFileError
from tests.apps.audit.room import (
    FOCAL,
    HEIGHT,
    WIDTH,
    picture,
    round_poses,
    wall_points,
    write_colmap,
    write_nerfstudio,
)

SOME = {
    "SIMPLE_RADIAL": (400.0, 320.0, 240.0, -0.12),
    "RADIAL": (400.0, 320.0, 240.0, -0.12, 0.03),
    "OPENCV": (400.0, 410.0, 320.0, 240.0, -0.12, 0.03, 0.002, -0.003),
    "FULL_OPENCV": (400.0, 410.0, 320.0, 240.0, -0.1, 0.02, 0.002, -0.003, 0.01, 0.05, 0.01, 0.0),
    "OPENCV_FISHEYE": (400.0, 410.0, 320.0, 240.0, 0.05, -0.01, 0.003, 0.001),
    "SIMPLE_RADIAL_FISHEYE": (400.0, 320.0, 240.0, 0.05),
    "RADIAL_FISHEYE": (400.0, 320.0, 240.0, 0.05, -0.01),
    "THIN_PRISM_FISHEYE": (
        400.0,
        410.0,
        320.0,
        240.0,
        0.05,
        -0.01,
        0.002,
        -0.001,
        0.003,
        0.001,
        0.004,
        -0.002,
    ),
    "FOV": (400.0, 410.0, 320.0, 240.0, 0.9),
    "EUCM": (400.0, 410.0, 320.0, 240.0, 0.6, 1.1),
    "SIMPLE_DIVISION": (400.0, 320.0, 240.0, -0.2),
    "DIVISION": (400.0, 410.0, 320.0, 240.0, -0.1),
}


@pytest.mark.parametrize("model", SOME)
def test_distortion_is_colmaps(model):
    pycolmap = pytest.importorskip("pycolmap")
    lens = Lens(model, 640, 480, SOME[model])
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-0.7, 0.7, (2, 50))
    camera = pycolmap.Camera(model=model, width=640, height=480, params=list(SOME[model]))
    expected = np.asarray(camera.img_from_cam(np.stack([x, y, np.ones_like(x)], axis=1)))
    fx, fy, cx, cy = lens.intrinsics
    found_x, found_y = distorted(lens, x, y)
    found = np.stack([fx * found_x + cx, fy * found_y + cy], axis=1)
    np.testing.assert_allclose(found, expected, atol=1e-6)


@given(width=st.integers(1, 60), height=st.integers(1, 60), stride=st.integers(1, 7))
def test_a_thinned_pixel_looks_where_the_pixel_that_it_takes_looks(width, height, stride):
    lens = Lens("PINHOLE", width, height, (31.0, 37.0, 0.4 * width, 0.6 * height))
    table, camera = sampling_table(lens, stride), thinned(lens.camera, stride)
    assert table.row.shape == (camera.height, camera.width)
    assert table.is_there.all()
    fx, fy, cx, cy = lens.intrinsics
    column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    slope = lambda at, center, focal: (at - float(center)) / float(focal)
    np.testing.assert_allclose(
        slope(column, camera.cx, camera.fx), (table.column + 0.5 - cx) / fx, atol=1e-4
    )
    np.testing.assert_allclose(
        slope(row, camera.cy, camera.fy), (table.row + 0.5 - cy) / fy, atol=1e-4
    )


def test_nothing_is_invented_where_the_lens_saw_nothing():
    lens = Lens("SIMPLE_RADIAL", 64, 48, (40.0, 32.0, 24.0, 0.6))  # bends corners far outwards
    table = sampling_table(lens, 1)
    assert 0.3 < table.is_there.mean() < 1.0
    image = np.full((48, 64, 3), 200, np.uint8)
    taken = table.take(image)
    np.testing.assert_array_equal(taken[~table.is_there], 0)
    np.testing.assert_array_equal(taken[table.is_there], 200)
    assert table.is_there[24, 32]
    assert (image == 200).all()


def test_a_lens_nobody_straightens_here_is_named():
    params = (40.0, 40.0, 32.0, 24.0, *[0.1] * (len(MODELS["RAD_TAN_THIN_PRISM_FISHEYE"][1]) - 4))
    with pytest.raises(ForeignFileError, match="RAD_TAN_THIN_PRISM_FISHEYE"):
        sampling_table(Lens("RAD_TAN_THIN_PRISM_FISHEYE", 64, 48, params), 2)


CAMERA = Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
POSES = round_poses()


@given(st.integers(0, len(POSES) - 1))
def test_a_pixel_has_the_depth_of_the_wall_that_it_shows(index):
    """A point lies anywhere in its pixel: its depth lies between those of the pixels around.

    In a corner of the room it is deeper than all of them, by less than a pixel is wide.
    """
    xyz, rgb = wall_points()
    depth, colors = sparse_depth(CAMERA, POSES[index], xyz, rgb, hides=True)
    truth_rgb, truth = picture(POSES[index])
    row, column = np.nonzero(depth)
    inner = (row > 0) & (row < HEIGHT - 1) & (column > 0) & (column < WIDTH - 1)
    row, column = row[inner], column[inner]
    around = np.stack([truth[row + i, column + j] for i in (-1, 0, 1) for j in (-1, 0, 1)])
    assert len(row) > 60
    assert (depth[row, column] >= around.min(axis=0) - 1e-3).all()
    assert (depth[row, column] <= around.max(axis=0) * (1 + 1 / FOCAL)).all()
    off = np.abs(colors[row, column].astype(int) - truth_rgb[row, column]).max(axis=1)
    assert np.median(off) < 8
    assert not colors[depth == 0].any()


def test_a_near_point_hides_the_one_behind_it_only_if_asked():
    camera = Camera(640, 480, 400.0, 400.0, 320.0, 240.0)
    xyz = np.array([[0.02, 0.0, 2.0], [0.0, 0.0, 4.0], [1.5, 0.0, 4.0], [0.0, 0.0, -3.0]])
    rgb = np.arange(12, dtype=np.uint8).reshape(4, 3)
    every = sparse_depth(camera, np.eye(4), xyz, rgb, hides=False)[0]
    front = sparse_depth(camera, np.eye(4), xyz, rgb, hides=True)[0]
    assert sorted(every[every > 0]) == [2.0, 4.0, 4.0]
    assert sorted(front[front > 0]) == [2.0, 4.0]  # the one aside stays
    # In one pixel the nearest counts, hidden or not.
    column = xyz[:2] * [0.0, 1.0, 1.0]
    depth, colors = sparse_depth(camera, np.eye(4), column, rgb[:2], hides=False)
    assert depth[depth > 0].tolist() == [2.0]
    assert colors[depth > 0].tolist() == [rgb[0].tolist()]


def test_no_points_are_no_depth():
    none = np.zeros((0, 3))
    depth, colors = sparse_depth(CAMERA, np.eye(4), none, none.astype(np.uint8), hides=True)
    assert depth.shape == (HEIGHT, WIDTH)
    assert not depth.any()
    assert not colors.any()


def test_pixels_that_alpha_cuts_out_have_no_depth(tmp_path):
    path = write_nerfstudio(tmp_path / "masked", POSES[:2], depth=True)
    name = path / "images" / "000.png"
    alpha = np.full((HEIGHT, WIDTH), 255, np.uint8)
    alpha[:, :20] = 0
    Image.fromarray(np.dstack([np.asarray(Image.open(name)), alpha])).save(name)
    images = read_transforms(path)
    rgb, depth = source_of(images, "masked").read(0)
    assert not depth[:, :20].any()
    assert not rgb[:, :20].any()
    assert (depth[:, 20:] > 0).all()
    np.testing.assert_array_equal(depth, np.asarray(images.frame(0).depth))


def dense_source() -> Source:
    rgb, depth = picture(round_poses(1)[0])
    lens = Lens("PINHOLE", WIDTH, HEIGHT, (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2))
    return Source("room", round_poses(1), (lens,), ("a",), "depth", True, None, 1,
                  lambda index: (rgb, depth.astype(np.float32)))  # fmt: skip


def test_depth_along_the_ray_and_in_other_units_is_converted():
    source = dense_source()
    _, z = source.read(0)
    v, u = np.indices(z.shape) + 0.5
    ray = np.sqrt(1 + ((u - WIDTH / 2) / FOCAL) ** 2 + ((v - HEIGHT / 2) / FOCAL) ** 2)
    stored = replace(source, read=lambda index: (source.read(index)[0], 50.0 * z * ray))
    _, found = stored.with_depth(0.02, is_along_ray=True).read(0)
    np.testing.assert_allclose(found, z, rtol=1e-5)


def test_depth_from_points_is_not_converted():
    with pytest.raises(ValueError, match="--depth-along-ray"):
        replace(dense_source(), kind="cloud").with_depth(is_along_ray=True)
    with pytest.raises(ValueError, match="--depth-scale"):
        dense_source().with_depth(-1.0)


def written(folder, poses, points):
    path = write_nerfstudio(folder, poses, depth=False)
    write_points(path / "points.ply", points, np.zeros((len(points), 3), np.uint8))
    return read_transforms(path)


def test_points_of_another_scene_or_scale_are_refused_with_the_numbers(tmp_path):
    points, _ = wall_points()
    assert len(source_of(written(tmp_path / "own", round_poses(), points), "room")) == 16
    away = points + np.array([1000.0, 0.0, 0.0])
    with pytest.raises(FormatError, match=r"points\.ply.* cameras .* 1e\+03 apart"):
        source_of(written(tmp_path / "away", round_poses(), away), "room")
    with pytest.raises(FormatError, match="cameras have none of its points"):
        source_of(written(tmp_path / "small", round_poses(), points * 1e-3), "room")


def test_poses_of_another_convention_are_refused(tmp_path):
    path = write_colmap(tmp_path, round_poses())
    images = read_colmap(path)
    turned = images.poses @ np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's axes
    with pytest.raises(FormatError, match="behind the cameras"):
        source_of(replace(images, poses=turned), "room")


def test_poses_that_are_placeholders_are_refused(tmp_path):
    images = read_colmap(write_colmap(tmp_path, round_poses()))
    same = np.repeat(images.poses[:1], len(images), axis=0)
    with pytest.raises(FormatError, match="poses of all 16 images are equal"):
        source_of(replace(images, poses=same), "room")


def test_photos_that_are_not_where_the_file_says_are_named(tmp_path):
    path = write_nerfstudio(tmp_path, round_poses(), depth=True)
    content = json.loads((path / "transforms.json").read_text())
    for frame in content["frames"]:
        del frame["depth_file_path"]
        frame["file_path"] = frame["file_path"].replace("images", "frames").replace("0", "1")
    (path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(FormatError, match=r"photos would do, but .*frames/111\.png is missing"):
        source_of(read_transforms(path), "room")
