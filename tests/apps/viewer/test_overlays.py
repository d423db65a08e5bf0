"""Frusta end where their cameras' images do; the path, points and splats are those of the run."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.apps.viewer.drawing import (
    frustum_corners,
    frustum_segments,
    path_segments,
    pose_of,
    quaternion,
    recorded_points,
    splat_arrays,
)
from r3jax.geometry.cameras import Camera, invert_pose, pose_along, project, transform
from r3jax.splatting.scene import DEAD_LOGIT, GaussianScene
from tests.runs.runs import make_flight

number = st.floats(-1.0, 1.0).filter(lambda x: abs(x) > 1e-3)


@given(st.tuples(number, number, number, number))
def test_quaternions_and_matrices_are_inverse(q):
    wxyz = np.array(q) / np.linalg.norm(q)
    pose = pose_of(wxyz, np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    assert pose[:3, 3].tolist() == [1.0, 2.0, 3.0]
    back = np.array(quaternion(pose[:3, :3]))
    assert back[0] >= 0.0
    np.testing.assert_allclose(back, wxyz * np.sign(wxyz[0]), atol=1e-7)


def test_the_corners_of_a_frustum_project_to_the_corners_of_the_image():
    camera = Camera(40, 30, 33.0, 31.0, 18.0, 16.0)  # off-center, oblong pixels
    T = pose_along(np.array([1.0, -2.0, 0.5]), np.array([0.4, 0.5, -0.3]))
    corners = frustum_corners(camera, np.asarray(T, np.float64), 2.0)
    inside = transform(invert_pose(T), jnp.asarray(corners, jnp.float32))
    pixels, depth = project(camera, inside)
    np.testing.assert_allclose(pixels, [[0, 0], [40, 0], [40, 30], [0, 30]], atol=1e-3)
    np.testing.assert_allclose(depth, 2.0, atol=1e-5)


def test_a_frustum_is_tied_to_its_camera_and_its_tick_is_above_it():
    camera = Camera.from_fov(32, 24, 60.0)
    T = np.asarray(pose_along(np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])), np.float64)
    segments = frustum_segments(camera, T, 0.5)
    assert segments.shape == (9, 2, 3)
    np.testing.assert_allclose(segments[:4, 0], np.repeat([[0.0, 0.0, 1.0]], 4, axis=0))
    top = segments[:8].reshape(-1, 3)[:, 2].max()
    assert segments[8, 0, 2] == pytest.approx(top)
    assert segments[8, 1, 2] > top + 0.05


def test_the_path_goes_through_every_view_in_order(run):
    rows = run.rows
    segments, colors = path_segments(rows, len(rows))
    np.testing.assert_allclose(segments[0, 0], rows[0].pose[:3, 3], atol=1e-5)
    np.testing.assert_allclose(segments[-1, 1], rows[-1].pose[:3, 3], atol=1e-5)
    np.testing.assert_allclose(segments[1:, 0], segments[:-1, 1], atol=1e-5)
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1).sum()
    assert length == pytest.approx(rows[-1].metres, rel=1e-4)
    assert colors.shape == segments.shape
    assert len(path_segments(rows[:1], len(rows))[0]) == 0


def test_no_path_leads_from_run_to_run_and_corners_on_the_way_stay():
    corner = np.array([[0.0, 0.0, 1.0], [0.3, 0.0, 1.0], [0.3, 0.5, 1.0]])
    first = make_flight([(corner, 4), (corner, 2)])[:-1]  # ends on the way
    rows = [*first, *make_flight([(corner + 2.0, 1)], first[-1])]
    segments, colors = path_segments(rows, len(rows))
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1).sum()
    assert length == pytest.approx(rows[-1].metres, rel=1e-5)
    assert colors.shape == segments.shape


def test_the_path_of_a_part_is_a_part_of_the_path(run):
    whole, colors = path_segments(run.rows, len(run.rows))
    part, early = path_segments(run.rows[:3], len(run.rows))
    np.testing.assert_array_equal(part, whole[: len(part)])
    np.testing.assert_array_equal(early, colors[: len(part)])


def test_recorded_points_are_pixels_of_the_frames(run):
    points, colors = recorded_points(run, 100)
    assert len(points) == len(colors) == 100
    share = 100 // len(run.rows)
    for step in (0, 3):
        frame = run.frame(step)
        mine = slice(step * share, (step + 1) * share)
        inside = transform(invert_pose(frame.T_world_camera), jnp.asarray(points[mine]))
        pixels, depth = (np.asarray(x) for x in project(frame.camera, inside))
        np.testing.assert_allclose(pixels % 1.0, 0.5, atol=5e-3)
        u, v = np.floor(pixels).astype(int).T
        np.testing.assert_allclose(depth, np.asarray(frame.depth)[v, u], atol=1e-4)
        expected = np.rint(np.asarray(frame.rgb)[v, u] * 255.0)
        np.testing.assert_array_equal(colors[mine], expected)


def scene_of(num: int) -> GaussianScene:
    rng = np.random.default_rng(0)
    logits = rng.normal(size=num)
    logits[1] = DEAD_LOGIT
    arrays = (
        rng.normal(size=(num, 3)),
        rng.normal(size=(num, 4)),
        rng.normal(size=(num, 3)) - 3.0,
        logits,
        rng.normal(size=(num, 4, 3)),
    )
    return GaussianScene(*(jnp.asarray(x, jnp.float32) for x in arrays))


def test_splats_keep_their_centers_shapes_and_colors():
    scene = scene_of(6)
    centers, covariances, colors, opacities = splat_arrays(scene)
    alive = [0, 2, 3, 4, 5]
    np.testing.assert_array_equal(centers, np.asarray(scene.means)[alive])
    np.testing.assert_allclose(covariances, covariances.transpose(0, 2, 1), atol=1e-7)
    variances = np.sort(np.linalg.eigvalsh(covariances.astype(np.float64)), axis=1)
    expected = np.sort(np.exp(2.0 * np.asarray(scene.log_scales)[alive]), axis=1)
    np.testing.assert_allclose(variances, expected, rtol=1e-3)
    np.testing.assert_allclose(
        opacities[:, 0], 1.0 / (1.0 + np.exp(-np.asarray(scene.opacity_logits)[alive])), atol=1e-6
    )
    expected = (np.asarray(scene.sh)[alive, 0] * 0.28209479 + 0.5).clip(0.0, 1.0)
    np.testing.assert_allclose(colors, expected, atol=1e-6)


def test_of_too_many_splats_those_that_cover_most_are_drawn():
    scene = scene_of(40)
    centers, _, _, opacities = splat_arrays(scene, 10)
    assert len(centers) == 10
    scales = np.sort(np.exp(np.asarray(scene.log_scales, np.float64)), axis=1)
    opacity = 1.0 / (1.0 + np.exp(-np.asarray(scene.opacity_logits, np.float64)))
    cover = opacity * scales[:, 1] * scales[:, 2]
    best = np.sort(np.argsort(-cover)[:10])
    np.testing.assert_allclose(centers, np.asarray(scene.means)[best])
    np.testing.assert_allclose(opacities[:, 0], opacity[best], atol=1e-6)
