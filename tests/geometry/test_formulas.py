"""Faults planted in the geometry: laws of fixed examples must notice each of them."""

import jax
import jax.numpy as jnp
import numpy as np

from r3jax.geometry import cameras, numerics, sphere, voxels

INDEX = np.array([[-(1 << 20), -3, 0, 5], [7, -1, (1 << 20) - 1, 2], [0, 1 << 15, -9, -1]])
DIRECTIONS = np.random.default_rng(0).normal(size=(500, 3))
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)


def test_packing() -> None:
    low, high = voxels.pack(*jnp.asarray(INDEX, jnp.int32))
    x, y, z = INDEX.astype(object) + (1 << 20)
    assert list(np.asarray(low).astype(object) + (np.asarray(high).astype(object) << 32)) == list(
        x + (y << 21) + (z << 42)
    )
    np.testing.assert_array_equal(jnp.stack(voxels.unpack(low, high)), INDEX)


def test_index() -> None:
    size = jnp.float32(0.0625)
    points = jnp.array([-0.0626, -0.0625, -0.01, 0.0, 0.0624, 0.0625, -1e9, 1e9])
    index = voxels.voxel_index(points, size)
    np.testing.assert_array_equal(index, [-2, -1, -1, 0, 0, 1, -(1 << 20), (1 << 20) - 1])
    np.testing.assert_array_equal(voxels.voxel_center(index[1:3], size), [-0.03125, -0.03125])


def test_nearest() -> None:
    k = np.arange(64)
    z, azimuth = 1.0 - (2 * k + 1) / 64, np.pi * k * (np.sqrt(5.0) - 1.0)
    lattice = np.stack([np.cos(azimuth), np.sin(azimuth), z / np.sqrt(1 - z**2)], axis=1)
    lattice *= np.sqrt(1 - z**2)[:, None]
    np.testing.assert_allclose(sphere.fibonacci_lattice(64), lattice, atol=1e-12)
    find = jax.jit(sphere.nearest_bin, static_argnums=1)
    found = np.asarray(find(jnp.asarray(DIRECTIONS.T, jnp.float32), 64))
    cosine = DIRECTIONS @ lattice.T
    lost = cosine.max(axis=1) - cosine[np.arange(len(found)), found]
    assert lost.max() < 2e-6


def test_camera() -> None:
    camera = cameras.Camera(12, 8, 9.0, 11.0, 5.5, 4.25)
    depth = jnp.asarray(np.random.default_rng(0).uniform(0.3, 6.0, (8, 12)), jnp.float32)
    points = cameras.unproject(camera, depth)
    ray = np.array([-2.0 / 9.0, -1.75 / 11.0, 1.0])
    np.testing.assert_allclose(points[2, 3], ray * float(depth[2, 3]), rtol=1e-5)
    pixels, z = cameras.project(camera, points)
    column, row = np.meshgrid(np.arange(12) + 0.5, np.arange(8) + 0.5)
    np.testing.assert_allclose(pixels, np.stack([column, row], axis=-1), atol=1e-4)
    np.testing.assert_allclose(z, depth, rtol=1e-6)
    assert float(cameras.Camera.from_fov(8, 6, 90.0).fy) == 4.0


def test_pose() -> None:
    position, target = jnp.array([1.0, -2.0, 1.5]), jnp.array([3.0, 1.0, 0.2])
    for aim in (target, position + jnp.array([0.0, 0.0, 2.0]), position - jnp.array([0, 0, 1.0])):
        T = np.asarray(cameras.look_at(position, aim))
        R, forward = T[:3, :3], np.asarray(aim - position)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-6)
        np.testing.assert_allclose(np.linalg.det(R), 1.0, rtol=1e-6)
        np.testing.assert_allclose(R[:, 2], forward / np.linalg.norm(forward), atol=1e-6)
        assert T[2, 0] == 0.0
        assert T[2, 1] < 1e-6
        np.testing.assert_allclose(cameras.invert_pose(jnp.asarray(T)) @ T, np.eye(4), atol=1e-5)
        np.testing.assert_allclose(
            cameras.transform(jnp.asarray(T), jnp.array([[1.0, 2.0, 3.0]])),
            np.array([[1.0, 2.0, 3.0]]) @ R.T + T[:3, 3],
            rtol=1e-5,
        )


def test_safe() -> None:
    zero = jnp.zeros(())
    assert float(numerics.safe_power(zero, zero)) == 1.0
    assert float(numerics.safe_power(zero, zero + 2.0)) == 0.0
    np.testing.assert_allclose(numerics.safe_power(zero + 2.0, zero + 3.0), 8.0, rtol=1e-6)
    np.testing.assert_allclose(numerics.safe_norm(jnp.array([3.0, 4.0])), 5.0)
    gradients = [
        *jax.grad(numerics.safe_power, argnums=(0, 1))(zero, zero + 0.5),
        *jax.grad(numerics.safe_norm)(jnp.zeros(2)),
    ]
    assert np.isfinite(gradients).all()
