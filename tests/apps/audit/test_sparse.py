"""Sparse depth from points: each where the camera shows it, and nothing that is hidden."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from r3jax.apps.audit.sparse import sparse_depth
from r3jax.geometry.cameras import Camera
from tests.apps.audit.room import FOCAL, HEIGHT, WIDTH, picture, round_poses, wall_points

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
