"""A malformed frame cannot be made, and the error names what is wrong."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera

CAMERA = Camera.from_fov(8, 6)
SOUND = {
    "rgb": np.full((6, 8, 3), 0.5, dtype=np.float32),
    "depth": np.full((6, 8), 2.0, dtype=np.float32),
    "T_world_camera": np.eye(4, dtype=np.float32),
    "camera": CAMERA,
}


def with_value(name: str, place: tuple[int, ...], value: float) -> dict[str, np.ndarray]:
    changed = SOUND[name].copy()
    changed[place] = value
    return {name: changed}


def test_a_sound_frame_is_kept_as_it_is():
    frame = Frame(**SOUND)
    np.testing.assert_array_equal(frame.rgb, SOUND["rgb"])
    np.testing.assert_array_equal(frame.depth, SOUND["depth"])
    np.testing.assert_array_equal(frame.position, np.zeros(3))


def test_no_measurement_and_out_of_range_are_sound():
    frame = Frame(**SOUND | {"depth": np.where(np.eye(6, 8) > 0, np.inf, 0.0)})
    assert frame.depth.dtype == jnp.float32


@pytest.mark.parametrize("kind", [np.float64, np.int32])
def test_poses_become_float32(kind):
    assert Frame(**SOUND | {"T_world_camera": np.eye(4, dtype=kind)}).position.dtype == jnp.float32


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.float64])
def test_images_of_any_precision_become_float32(kind):
    frame = Frame(**SOUND | {name: SOUND[name].astype(kind) for name in ("rgb", "depth")})
    assert frame.rgb.dtype == frame.depth.dtype == jnp.float32
    np.testing.assert_array_equal(frame.depth, SOUND["depth"])


BAD = {
    "rgb of another size": ({"rgb": np.zeros((6, 9, 3), np.float32)}, r"rgb has shape \(6, 9, 3\)"),
    "rgb with alpha": ({"rgb": np.zeros((6, 8, 4), np.float32)}, r"rgb has shape \(6, 8, 4\)"),
    "transposed": ({"rgb": np.zeros((8, 6, 3), np.float32)}, r"camera's image is \(6, 8, 3\)"),
    "depth of another size": ({"depth": np.ones((3, 4), np.float32)}, r"depth has shape \(3, 4\)"),
    "depth with a channel": ({"depth": np.ones((6, 8, 1), np.float32)}, "depth has shape"),
    "float depth in mm": ({"depth": np.full((6, 8), 2e3)}, r"median depth is 2000 m.*millimeters"),
    "another camera": ({"camera": Camera.from_fov(16, 12)}, "camera's image is"),
    "uint8 image": ({"rgb": np.zeros((6, 8, 3), np.uint8)}, "rgb must be float32, got uint8.*255"),
    "depth in mm": ({"depth": np.full((6, 8), 900, np.uint16)}, "depth must be float32.*meters"),
    "rgb above 1": (with_value("rgb", (1, 2, 0), 255.0), r"rgb must lie in \[0, 1\].* to 255"),
    "rgb below 0": (with_value("rgb", (1, 2, 0), -0.1), r"rgb must lie in \[0, 1\].* from -0.1"),
    "rgb NaN": (with_value("rgb", (1, 2, 0), np.nan), r"rgb must lie in \[0, 1\].* nan"),
    "depth NaN": (with_value("depth", (1, 2), np.nan), "depth.* 1 pixels.* row 1, column 2: nan"),
    "depth negative": (with_value("depth", (4, 7), -1.0), r"depth.*row 4, column 7: -1\.0"),
    "depth minus inf": (with_value("depth", (0, 0), -np.inf), "depth.*row 0, column 0: -inf"),
    "pose 3x4": ({"T_world_camera": np.eye(4)[:3]}, "T_world_camera is a 4x4 matrix"),
    "pose NaN": (with_value("T_world_camera", (0, 3), np.nan), "T_world_camera.*not finite"),
    "pose scaled": ({"T_world_camera": np.diag([2.0, 2.0, 2.0, 1.0])}, "T_world_camera.*not rigid"),
    "pose sheared": (with_value("T_world_camera", (0, 1), 0.2), "T_world_camera.*not rigid"),
    "pose mirrored": (
        {"T_world_camera": np.diag([1.0, -1.0, 1.0, 1.0])},
        "T_world_camera.*mirrors",
    ),
    "pose of UTM": (with_value("T_world_camera", (1, 3), -4.6e6), "coordinate 4,600,000 m.*origin"),
    "pose transposed": (with_value("T_world_camera", (3, 0), 1.0), "T_world_camera.*last row"),
}


@pytest.mark.parametrize(("change", "words"), BAD.values(), ids=BAD.keys())
def test_bad_frame_is_refused(change, words):
    with pytest.raises(ValueError, match=words):
        Frame(**SOUND | change)


def test_what_is_far_indeed_is_taken_on_the_callers_word():
    far = np.full((6, 8), 2e3)
    assert float(Frame(**SOUND | {"depth": far}, far=True).depth[0, 0]) == 2e3
    assert float(Frame(**SOUND | {"depth": np.where(far > 0, np.inf, far)}).depth[0, 0]) == np.inf


def test_frames_pass_through_transformations():
    frame = Frame(**SOUND)
    stack = jax.tree.map(lambda x: jnp.stack([x, x]), frame)
    depth = jax.jit(jax.vmap(lambda one: jnp.sum(one.depth)))(stack)
    np.testing.assert_array_equal(depth, [96.0, 96.0])


def test_structure_is_checked_under_jit_too():
    build = jax.jit(lambda rgb: Frame(**SOUND | {"rgb": rgb}).rgb)
    assert build(jnp.full((6, 8, 3), 2.0)).shape == (6, 8, 3)  # values are not known there
    with pytest.raises(ValueError, match="rgb"):
        build(jnp.zeros((5, 8, 3)))
