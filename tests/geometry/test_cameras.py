"""Projection, poses and their inverses; what is said of bad ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given

from r3jax.geometry.cameras import (
    Camera,
    invert_pose,
    is_traced,
    look_at,
    pixel_rays,
    pose_along,
    project,
    rigid_error,
    transform,
    unproject,
)
from tests.strategies import directions, points

CAMERA = Camera(12, 8, 9.0, 11.0, 5.5, 4.25)  # nothing square, nothing centered

pose = jax.jit(pose_along)
pose_gradient = jax.jit(jax.jacfwd(pose_along, argnums=1))


def test_projection_undoes_unprojection():
    depth = np.random.default_rng(0).uniform(0.3, 6.0, (8, 12)).astype(np.float32)
    pixels, z = project(CAMERA, unproject(CAMERA, jnp.asarray(depth)))
    column, row = np.meshgrid(np.arange(12) + 0.5, np.arange(8) + 0.5)
    np.testing.assert_allclose(pixels[..., 0], column, atol=1e-4)
    np.testing.assert_allclose(pixels[..., 1], row, atol=1e-4)
    np.testing.assert_allclose(z, depth, rtol=1e-6)


def test_depth_is_along_z_not_along_the_ray():
    depth = jnp.full((8, 12), 2.0)
    np.testing.assert_array_equal(unproject(CAMERA, depth)[..., 2], depth)
    np.testing.assert_array_equal(pixel_rays(CAMERA)[..., 2], np.ones((8, 12)))


def test_points_behind_the_camera_stay_finite():
    behind = jnp.array([[1.0, 2.0, -1.0], [1.0, 2.0, 0.0]])
    pixels, z = project(CAMERA, behind)
    assert np.isfinite(pixels).all()
    np.testing.assert_array_equal(z, [-1.0, 0.0])


def test_field_of_view_ends_at_the_image_border():
    camera = Camera.from_fov(64, 48, 60.0)
    border = jnp.array([[np.tan(np.pi / 6), 0.0, 1.0], [-np.tan(np.pi / 6), 0.0, 1.0]])
    pixels, _ = project(camera, border)
    np.testing.assert_allclose(pixels[:, 0], [64.0, 0.0], atol=1e-4)
    np.testing.assert_allclose(pixels[:, 1], 24.0, atol=1e-4)


def test_resizing_scales_pixels():
    half = CAMERA.resized(6, 2)
    somewhere = jnp.array([0.2, -0.1, 1.0])
    full_pixel, _ = project(CAMERA, somewhere)
    pixel, _ = project(half, somewhere)
    np.testing.assert_allclose(pixel, np.asarray(full_pixel) * [0.5, 0.25], rtol=1e-6)
    np.testing.assert_allclose(CAMERA.focal, np.sqrt(99.0), rtol=1e-6)


@given(points(), directions())
@example(np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.0, 1.0]))
@example(np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.0, -2.0]))
@example(np.array([0.0, 0.0, 0.0]), np.array([1e-9, 0.0, 1.0]))
def test_pose_along_is_rigid_level_and_looks_along(position, direction):
    T = np.asarray(pose(jnp.asarray(position, jnp.float32), jnp.asarray(direction, jnp.float32)))
    assert rigid_error(T) is None
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-5)
    np.testing.assert_allclose(T[:3, 2], direction / np.linalg.norm(direction), atol=1e-5)
    np.testing.assert_array_equal(T[:3, 3], position.astype(np.float32))
    assert T[2, 0] == 0.0  # the image's x axis is level
    assert T[2, 1] < 1e-6  # the image's y axis points down


def test_straight_up_and_down_take_the_worlds_x_axis():
    for z in (1.0, -1.0):
        T = pose(jnp.zeros(3), jnp.array([0.0, 0.0, z]))
        np.testing.assert_array_equal(T[:3, 0], [1.0, 0.0, 0.0])
        assert np.isfinite(pose_gradient(jnp.zeros(3), jnp.array([0.0, 0.0, z]))).all()


def test_look_at_centers_its_target():
    T = look_at(jnp.array([1.0, -2.0, 1.5]), jnp.array([3.0, 1.0, 0.2]))
    seen = transform(invert_pose(T), jnp.array([3.0, 1.0, 0.2]))
    np.testing.assert_allclose(seen[:2], 0.0, atol=1e-6)
    assert seen[2] > 0.0


def test_numbers_of_any_kind_are_welcome():
    expected = look_at(jnp.array([1.0, -2.0, 1.0]), jnp.zeros(3))
    np.testing.assert_array_equal(look_at(np.array([1, -2, 1]), np.zeros(3)), expected)
    backward = pose_along(np.array([1.0, -2.0, 1.0]), np.array([-1, 2, -1]))
    np.testing.assert_array_equal(backward, expected)
    of_matrix = Camera(12, 8, *np.array([9, 11, 5, 4], np.float32))
    assert float(of_matrix.fy) == float(Camera(12, 8, 9, 11, 5, 4).fy) == 11.0
    assert float(Camera.from_fov(12, 8, 60).fx) == float(Camera.from_fov(12, 8, 60.0).fx)


@given(points(), directions())
def test_inverse_undoes_the_pose(position, direction):
    T = pose(jnp.asarray(position, jnp.float32), jnp.asarray(direction, jnp.float32))
    np.testing.assert_allclose(invert_pose(T) @ T, np.eye(4), atol=2e-5)
    np.testing.assert_allclose(invert_pose(T), np.linalg.inv(np.float64(T)), atol=2e-5)


def test_transform_takes_any_leading_shape():
    T = look_at(jnp.array([1.0, -2.0, 1.5]), jnp.zeros(3))
    cloud = jnp.asarray(np.random.default_rng(1).normal(size=(2, 5, 3)), jnp.float32)
    expected = np.asarray(cloud) @ np.asarray(T)[:3, :3].T + np.asarray(T)[:3, 3]
    np.testing.assert_allclose(transform(T, cloud), expected, atol=1e-5)
    np.testing.assert_allclose(transform(T, cloud[0, 0]), expected[0, 0], atol=1e-5)


def changed(row: int, column: int, value: float) -> np.ndarray:
    T = np.eye(4)
    T[row, column] = value
    return T


@pytest.mark.parametrize(
    ("T", "words"),
    [
        (np.eye(3), "4x4"),
        (changed(0, 3, np.nan), "not finite"),
        (changed(1, 1, np.inf), "not finite"),
        (np.diag([2.0, 2.0, 2.0, 1.0]), "not rigid"),
        (changed(0, 1, 0.1), "not rigid"),
        (np.zeros((4, 4)), "not rigid"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "OpenGL"),
        (np.diag([2.0, 2.0, 2.0, 1.0]), "2: divide"),
        (changed(3, 0, 0.5), "last row"),
        (changed(3, 3, 2.0), "last row"),
    ],
)
def test_bad_pose_is_described(T, words):
    assert words in str(rigid_error(T))


def test_rounded_pose_is_accepted():
    T = np.asarray(look_at(jnp.array([1.0, -2.0, 1.5]), jnp.zeros(3)))
    assert rigid_error(np.round(T, 4)) is None


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((0, 8, 9.0, 9.0, 4.0, 4.0), "0 x 8"),
        ((8, -1, 9.0, 9.0, 4.0, 4.0), "8 x -1"),
        ((8, 8, 0.0, 9.0, 4.0, 4.0), "fx"),
        ((8, 8, 9.0, -9.0, 4.0, 4.0), "fy"),
        ((8, 8, np.nan, 9.0, 4.0, 4.0), "fx"),
        ((8, 8, np.inf, 9.0, 4.0, 4.0), "fx"),
        ((8, 8, 9.0, 9.0, np.nan, 4.0), "cx"),
        ((8, 8, 9.0, 9.0, 4.0, np.inf), "cy"),
    ],
)
def test_bad_intrinsics_are_refused(arguments, words):
    with pytest.raises(ValueError, match=words):
        Camera(*arguments)


@pytest.mark.parametrize("angle", [0.0, 180.0, -60.0, float("nan")])
def test_bad_field_of_view_is_refused(angle):
    with pytest.raises(ValueError, match="horizontal_fov_deg"):
        Camera.from_fov(8, 8, angle)


def test_camera_is_built_under_jit_where_values_are_unknown():
    focal = jax.jit(lambda f: Camera(8, 8, f, f, 4.0, 4.0).focal)(jnp.float32(3.0))
    np.testing.assert_allclose(focal, 3.0)
    assert not is_traced(jnp.zeros(2), np.zeros(2), 1.0)
    assert jax.jit(lambda x: jnp.asarray(is_traced(np.zeros(2), x)))(jnp.zeros(2))
