"""Frames from the arrays of other programs: NumPy, JAX, and anything that speaks DLPack."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera, look_at, project

HEIGHT, WIDTH = 6, 8
CAMERA = Camera(WIDTH, HEIGHT, 7.0, 6.0, 4.25, 2.75)
K = np.array([[7.0, 0.0, 3.75], [0.0, 6.0, 2.25], [0.0, 0.0, 1.0]])
"""The same camera as OpenCV has it: the center of the upper left pixel at (0, 0)."""

POSE = np.asarray(look_at(np.array([1.0, 2.0, 0.5]), np.array([0.0, 0.0, 1.0])), np.float64)


class Foreign:
    """An array of a library that this package has never heard of: DLPack and nothing else."""

    def __init__(self, array: np.ndarray, device: tuple[int, int] | None = None):
        self._array = array
        self._device = device or array.__dlpack_device__()

    def __dlpack__(self, **options):
        return self._array.__dlpack__(**options)

    def __dlpack_device__(self):
        return self._device


class Unwilling(Foreign):
    """Refuses, as PyTorch does where gradients are wanted."""

    def __dlpack__(self, **options):
        raise BufferError("can't export tensors that require gradient")


def images(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """8-bit colors, and depth in whole millimeters with holes."""
    random = np.random.default_rng(seed)
    rgb = random.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    depth = random.integers(0, 5000, (HEIGHT, WIDTH), dtype=np.uint16)
    depth[random.random(depth.shape) < 0.2] = 0
    return rgb, depth


RGB, STEPS = images()
SOUND = {"rgb": RGB, "depth": STEPS, "T_world_camera": POSE, "camera": CAMERA, "depth_scale": 0.001}
EXPECTED = Frame((RGB / 255).astype(np.float32), (STEPS / 1000).astype(np.float32), POSE, CAMERA)
KINDS = {"numpy": np.asarray, "jax": jnp.asarray, "dlpack": Foreign, "list": np.ndarray.tolist}


def assert_same_frame(actual: Frame, expected: Frame = EXPECTED) -> None:
    assert (actual.camera.width, actual.camera.height) == (WIDTH, HEIGHT)
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(actual))
    # JAX divides by multiplying: the last bit may differ.
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-7)
    jax.tree.map(close, actual, expected)


@pytest.mark.parametrize("kind", [KINDS["numpy"], KINDS["jax"], KINDS["dlpack"]])
def test_every_kind_of_array_gives_the_same_frame(kind):
    arrays = {name: kind(SOUND[name]) for name in ("rgb", "depth")}
    pose = kind(POSE.astype(np.float32))
    assert_same_frame(Frame.from_arrays(**SOUND | arrays | {"T_world_camera": pose}))


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS.keys())
def test_a_matrix_of_intrinsics_is_a_camera(kind):
    assert_same_frame(Frame.from_arrays(**SOUND | {"camera": kind(K.astype(np.float32))}))
    shifted = np.add(K, [[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
    assert_same_frame(Frame.from_arrays(**SOUND | {"camera": kind(shifted)}, pixel_center=0.5))


@given(st.integers(0, HEIGHT - 1), st.integers(0, WIDTH - 1), st.floats(0.5, 4.0))
def test_a_matrix_projects_as_in_opencv(row, column, z):
    """A point whose OpenCV pixel is (column, row) lies at the center of that pixel here."""
    point = z * np.linalg.solve(K, np.array([column, row, 1.0]))
    camera = Frame.from_arrays(**SOUND | {"camera": K}).camera
    pixel, depth = project(camera, jnp.asarray(point, jnp.float32))
    np.testing.assert_allclose(pixel, [column + 0.5, row + 0.5], atol=1e-4)
    assert float(depth) == pytest.approx(z, rel=1e-6)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
@pytest.mark.parametrize("kind", [np.asarray, Foreign])
def test_floats_are_colors_from_0_to_1_and_meters(dtype, kind):
    rgb, depth = (RGB / 255).astype(dtype), (STEPS / 1000).astype(dtype)
    frame = Frame.from_arrays(kind(rgb), kind(depth), POSE, CAMERA)
    np.testing.assert_array_equal(frame.rgb, rgb.astype(np.float32))
    np.testing.assert_array_equal(frame.depth, depth.astype(np.float32))


@pytest.mark.parametrize("dtype", [np.uint16, np.int32, np.uint8, ">u2", np.float32, np.float64])
def test_depth_may_have_any_unit(dtype):
    steps = np.arange(HEIGHT * WIDTH, dtype=dtype).reshape(HEIGHT, WIDTH)
    frame = Frame.from_arrays(**SOUND | {"depth": steps, "depth_scale": 0.02})
    np.testing.assert_allclose(frame.depth, 0.02 * np.arange(48).reshape(6, 8), rtol=2e-7)


def test_beyond_range_stays_beyond_range():
    depth = np.where(STEPS == 0, np.inf, STEPS).astype(np.float32)
    frame = Frame.from_arrays(**SOUND | {"depth": depth})
    np.testing.assert_array_equal(np.isinf(frame.depth), STEPS == 0)


@given(hnp.arrays(np.uint8, (HEIGHT, WIDTH, 3)))
def test_bytes_come_back(rgb):
    frame = Frame.from_arrays(**SOUND | {"rgb": rgb})
    np.testing.assert_array_equal(np.rint(np.asarray(frame.rgb) * 255.0), rgb)


@pytest.mark.parametrize("kind", [np.asarray, Foreign])
def test_memory_may_be_written_again(kind):
    """A driver writes the next picture into the buffer of the last."""
    rgb, depth, pose = RGB.astype(np.float32) / 255, STEPS / np.float32(1000), POSE.copy()
    pose32 = pose.astype(np.float32)
    kept = Frame.from_arrays(kind(rgb), kind(depth), kind(pose32), CAMERA)
    for array in (rgb, depth, pose32):
        array[...] = 0.0
    assert_same_frame(kept)


def test_strided_and_flipped_images_are_read_as_they_look():
    wide = np.zeros((HEIGHT, 2 * WIDTH, 3), np.uint8)
    wide[:, ::2] = RGB[:, :, ::-1]  # BGR, every second column
    assert_same_frame(Frame.from_arrays(**SOUND | {"rgb": wide[:, ::2, ::-1]}))


@given(hnp.arrays(np.bool_, (HEIGHT, WIDTH)))
def test_ignored_pixels_have_no_measurement(mask):
    frame = Frame.from_arrays(**SOUND, ignore=mask)
    np.testing.assert_array_equal(frame.depth, np.where(mask, 0.0, EXPECTED.depth))
    eight_bit = Frame.from_arrays(**SOUND, ignore=255 * mask.astype(np.uint8))
    np.testing.assert_array_equal(eight_bit.depth, frame.depth)


@pytest.mark.parametrize("convention", ["world-to-camera", "opengl", "ros"])
def test_conventions_are_converted_under_jit_too(convention):
    build = lambda pose: Frame.from_arrays(
        **SOUND | {"T_world_camera": pose}, convention=convention
    )
    expected = build(POSE).T_world_camera
    assert not np.allclose(expected, POSE)
    np.testing.assert_allclose(jax.jit(build)(POSE).T_world_camera, expected, atol=1e-6)


def test_frames_are_made_under_jit_too():
    build = jax.jit(lambda rgb, depth: Frame.from_arrays(rgb, depth, POSE, K, depth_scale=0.001))
    assert_same_frame(build(RGB, STEPS))


BAD = {
    "planar": {"rgb": RGB.transpose(2, 0, 1)},
    "alpha": {"rgb": np.zeros((6, 8, 4), np.uint8)},
    "batch": {"rgb": RGB[None]},
    "gray": {"rgb": RGB[..., 0]},
    "16-bit colors": {"rgb": RGB.astype(np.uint16)},
    "colors to 255": {"rgb": RGB.astype(np.float32)},
    "colors NaN": {"rgb": np.full((6, 8, 3), np.nan)},
    "no pixels": {"rgb": RGB[:0], "depth": STEPS[:0]},
    "no columns": {"rgb": RGB[:, :0], "camera": K},
    "depth of another size": {"depth": STEPS[:3]},
    "depth with a channel": {"depth": STEPS[..., None]},
    "steps without unit": {"depth_scale": None},
    "steps per meter": {"depth_scale": 1000},
    "unit zero": {"depth_scale": 0.0},
    "unit NaN": {"depth_scale": np.nan},
    "depth true and false": {"depth": STEPS > 0},
    "depth NaN": {"depth": np.where(STEPS > 0, 1.0, np.nan)},
    "depth negative": {"depth": -1 - STEPS.astype(np.int32)},
    "pose 3x4": {"T_world_camera": POSE[:3]},
    "pose scaled": {"T_world_camera": np.diag([2.0, 2.0, 2.0, 1.0])},
    "pose of OpenGL's hand": {"T_world_camera": np.diag([1.0, 1.0, -1.0, 1.0])},
    "pose NaN": {"T_world_camera": np.full((4, 4), np.nan)},
    "matrix 3x4": {"camera": np.eye(3, 4)},
    "matrix with skew": {"camera": K + np.eye(3, k=1)},
    "matrix transposed": {"camera": K.T},
    "matrix NaN": {"camera": K * np.nan},
    "matrix of large images": {"camera": K * [[80.0], [80.0], [1.0]]},
    "no focal length": {"camera": K * [[0.0, 1, 1], [1, 1, 1], [1, 1, 1]]},
    "another camera": {"camera": Camera.from_fov(16, 12)},
    "mask of another shape": {"ignore": np.zeros((3, 8), bool)},
    "mask of numbers": {"ignore": np.zeros((6, 8), np.float32)},
    "no such convention": {"convention": "unity"},
}


@pytest.mark.parametrize("change", BAD.values(), ids=BAD.keys())
def test_bad_arrays_are_refused(change):
    with pytest.raises(ValueError, match=f"(?i){next(iter(change))}|fx|rgb"):
        Frame.from_arrays(**SOUND | change)


NO_ARRAYS = {
    "a path": {"rgb": "image.png"},
    "nothing": {"depth": None},
    "rows of two lengths": {"depth": [[1.0], [1.0, 2.0]]},
    "wants gradients": {"depth": Unwilling(STEPS)},
    "on a device that is not here": {"rgb": Foreign(RGB, (4, 0))},
}


@pytest.mark.parametrize("change", NO_ARRAYS.values(), ids=NO_ARRAYS.keys())
def test_what_is_no_array_is_refused(change):
    with pytest.raises(TypeError, match=next(iter(change))):
        Frame.from_arrays(**SOUND | change)
