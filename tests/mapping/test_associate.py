"""Grouping of points by voxel against NumPy, in frames smaller and larger than the scratch."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera, look_at, transform, unproject
from r3jax.mapping import associate as real
from r3jax.mapping.associate import points_of_pixels

NUM = 96  # one shape: one compile
SIZE = 0.0625

group = jax.jit(real.group_by_voxel)


def crowd(seed: int, reach: int, spacing: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points [NUM, 3], colors and validity: several points a voxel, voxels `spacing` apart."""
    random = np.random.default_rng(seed)
    voxel = random.integers(-reach, reach, (NUM, 3)) * spacing
    inside = random.integers(0, 16, (NUM, 3)) / 16
    return (voxel + inside) * SIZE, random.random((NUM, 3)), random.random(NUM) < 0.8


def assert_grouped(group, points, rgb, valid) -> None:
    """Each valid voxel has one leader, which holds the sum and number of its valid points."""
    groups = group(
        jnp.asarray(points.T, jnp.float32),
        jnp.asarray(rgb, jnp.float32),
        jnp.asarray(valid),
        jnp.float32(SIZE),
    )
    voxel = np.floor(points / SIZE).astype(int)
    expected, inverse = np.unique(voxel[valid], axis=0, return_inverse=True)
    sums = np.zeros((len(expected), 4))
    np.add.at(sums, inverse.reshape(-1), np.concatenate([rgb, np.ones((NUM, 1))], axis=1)[valid])
    leader = np.flatnonzero(groups.is_leader)
    assert valid[leader].all(), "a point that is not valid leads"
    order = np.lexsort(voxel[leader].T[::-1])
    np.testing.assert_array_equal(voxel[leader][order], expected)
    np.testing.assert_allclose(np.asarray(groups.rgb_sum)[leader][order], sums, rtol=1e-5)
    number = ((voxel + (1 << 20)).astype(object) * [1, 1 << 21, 1 << 42]).sum(axis=1)
    low, high = np.asarray(groups.key).astype(object)
    assert (low + (high << 32) == number).all(), "a key is not its point's voxel"


@given(st.integers(0, 1 << 20), st.sampled_from([1, 2, 3]))
def test_points_of_a_small_frame_are_grouped(seed, reach):
    assert_grouped(group, *crowd(seed, reach, spacing=1))


@given(st.integers(0, 1 << 20), st.sampled_from([64, 128, 1000]))
def test_voxels_that_share_a_scratch_slot_are_told_apart(seed, spacing):
    assert_grouped(group, *crowd(seed, 3, spacing))


def test_one_crowded_voxel_and_no_voxel():
    points, rgb, valid = crowd(seed=0, reach=1, spacing=0)
    assert_grouped(group, points, rgb, valid)
    assert_grouped(group, points, rgb, np.zeros(NUM, dtype=bool))


def test_all_points_alone_in_one_scratch_slot():
    index = np.stack([np.arange(NUM) % 4, np.arange(NUM) // 4 % 4, np.arange(NUM) // 16], axis=1)
    points = (index * [128, 128, 64] - 200 + 0.5) * SIZE
    assert_grouped(group, points, np.random.default_rng(1).random((NUM, 3)), np.ones(NUM, bool))


def test_pixels_become_points_row_by_row():
    camera = Camera(6, 4, 5.0, 7.0, 2.5, 1.75)
    T = look_at(jnp.array([1.0, 2.0, 0.5]), jnp.array([-1.0, 0.0, 1.0]))
    depth = jnp.asarray(np.random.default_rng(0).uniform(0.5, 4.0, (4, 6)), jnp.float32)
    frame = Frame(rgb=jnp.zeros((4, 6, 3)), depth=depth, T_world_camera=T, camera=camera)
    expected = transform(T, unproject(camera, depth)).reshape(-1, 3).T
    np.testing.assert_allclose(points_of_pixels(frame, depth), expected, atol=1e-5)


# Laws of fixed examples ---------------------------------------------------------------------------


def test_near() -> None:
    assert_grouped(jax.jit(real.group_by_voxel), *crowd(5, 2, spacing=1))


def test_far() -> None:
    assert_grouped(jax.jit(real.group_by_voxel), *crowd(6, 3, spacing=64))
