"""What a frame refuses, in which words, and what it lets pass."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera, look_at

HEIGHT, WIDTH = 6, 8
CAMERA = Camera.from_fov(WIDTH, HEIGHT)


def frame_of(**changes) -> Frame:
    """A good frame, but for the changes."""
    parts = {
        "rgb": np.full((HEIGHT, WIDTH, 3), 0.5, np.float32),
        "depth": np.full((HEIGHT, WIDTH), 2.0, np.float32),
        "T_world_camera": np.eye(4),
        "camera": CAMERA,
    }
    return Frame(**(parts | changes))


def image_with(value: float, *shape: int) -> np.ndarray:
    """Ones, but for the pixel in row 2, column 5."""
    image = np.ones((HEIGHT, WIDTH, *shape), np.float32)
    image[2, 5] = value
    return image


def test_good_frame_keeps_what_it_was_given():
    T = look_at(jnp.array([1.0, -2.0, 1.5]), jnp.zeros(3))
    depth = image_with(np.inf)
    depth[0, 0] = 0.0
    frame = frame_of(depth=depth, T_world_camera=T)
    np.testing.assert_array_equal(frame.depth, depth)
    np.testing.assert_array_equal(frame.position, [1.0, -2.0, 1.5])
    np.testing.assert_array_equal(frame.T_world_camera, T)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_images_of_any_precision_become_float32(dtype):
    frame = frame_of(
        rgb=np.full((HEIGHT, WIDTH, 3), 0.25, dtype), depth=np.full((HEIGHT, WIDTH), 1.5, dtype)
    )
    assert frame.rgb.dtype == frame.depth.dtype == frame.T_world_camera.dtype == jnp.float32
    np.testing.assert_array_equal(frame.depth, 1.5)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rgb": np.zeros((WIDTH, HEIGHT, 3))}, r"rgb has shape \(8, 6, 3\), .* is \(6, 8, 3\)"),
        ({"rgb": np.zeros((HEIGHT, WIDTH, 4))}, r"rgb has shape \(6, 8, 4\)"),
        ({"rgb": np.zeros((HEIGHT, WIDTH))}, r"rgb has shape \(6, 8\)"),
        ({"depth": np.ones((3, 4))}, r"depth has shape \(3, 4\), .* is \(6, 8\)"),
        ({"depth": np.ones((HEIGHT, WIDTH, 1))}, r"depth has shape \(6, 8, 1\)"),
        ({"camera": Camera.from_fov(16, 12)}, r"camera's image is \(12, 16, 3\)"),
        ({"T_world_camera": np.eye(3)}, r"4x4 matrix, got shape \(3, 3\)"),
    ],
)
def test_sizes_that_differ_are_named(changes, words):
    with pytest.raises(ValueError, match=words):
        frame_of(**changes)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rgb": np.full((HEIGHT, WIDTH, 3), 128, np.uint8)}, "rgb must be float32, got uint8"),
        ({"rgb": np.zeros((HEIGHT, WIDTH, 3), np.uint8)}, "colour / 255"),
        ({"depth": np.full((HEIGHT, WIDTH), 2000, np.uint16)}, "depth must be float32, got uint16"),
        ({"depth": np.ones((HEIGHT, WIDTH), bool)}, "depth must be float32, got bool"),
    ],
)
def test_integer_images_are_refused_with_the_remedy(changes, words):
    with pytest.raises(ValueError, match=words):
        frame_of(**changes)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"depth": image_with(np.nan)}, "1 pixels are not, the first at row 2, column 5: nan"),
        ({"depth": image_with(-0.5)}, "the first at row 2, column 5: -0.5"),
        ({"depth": image_with(-np.inf)}, "row 2, column 5: -inf"),
        ({"rgb": image_with(1.5, 3)}, r"rgb must lie in \[0, 1\], got values from 1 to 1.5"),
        ({"rgb": image_with(-0.25, 3)}, "from -0.25 to 1"),
        ({"rgb": image_with(np.nan, 3)}, r"rgb must lie in \[0, 1\]"),
        ({"rgb": image_with(np.inf, 3)}, r"rgb must lie in \[0, 1\]"),
    ],
)
def test_bad_values_are_named(changes, words):
    with pytest.raises(ValueError, match=words):
        frame_of(**changes)


@pytest.mark.parametrize(
    ("T", "words"),
    [
        (np.full((4, 4), np.nan), "T_world_camera: the pose has entries that are not finite"),
        (np.diag([2.0, 2.0, 2.0, 1.0]), "T_world_camera: the pose is not rigid"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "T_world_camera: the pose mirrors"),
        (np.eye(4) + np.eye(4, k=3).T, "T_world_camera: the pose's last row"),
    ],
)
def test_bad_poses_are_named(T, words):
    with pytest.raises(ValueError, match=words):
        frame_of(T_world_camera=T)


def test_structure_is_checked_where_values_are_unknown():
    depth_sum = jax.jit(lambda depth: frame_of(depth=depth).depth.sum())
    np.testing.assert_allclose(depth_sum(jnp.full((HEIGHT, WIDTH), 2.0)), 2.0 * HEIGHT * WIDTH)
    assert np.isnan(depth_sum(jnp.full((HEIGHT, WIDTH), jnp.nan)))
    with pytest.raises(ValueError, match=r"depth has shape \(8, 6\)"):
        depth_sum(jnp.ones((WIDTH, HEIGHT)))


def test_frames_stack_and_map():
    frames = [frame_of(depth=image_with(value)) for value in (0.0, 3.0)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *frames)
    nearest = jax.vmap(lambda frame: frame.depth.min())(stacked)
    np.testing.assert_array_equal(nearest, [0.0, 1.0])
