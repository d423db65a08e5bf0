"""Faults planted in the geometry: laws of fixed examples must notice each of them."""

import jax
import jax.numpy as jnp
import numpy as np

from tests.mutants import Modules, Mutant, assert_caught, each, load

INDEX = np.array([[-(1 << 20), -3, 0, 5], [7, -1, (1 << 20) - 1, 2], [0, 1 << 15, -9, -1]])
DIRECTIONS = np.random.default_rng(0).normal(size=(500, 3))
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)


def law_packing(modules: Modules) -> None:
    voxels = modules["voxels"]
    low, high = voxels.pack(*jnp.asarray(INDEX, jnp.int32))
    x, y, z = INDEX.astype(object) + (1 << 20)
    assert list(np.asarray(low).astype(object) + (np.asarray(high).astype(object) << 32)) == list(
        x + (y << 21) + (z << 42)
    )
    np.testing.assert_array_equal(jnp.stack(voxels.unpack(low, high)), INDEX)


def law_index(modules: Modules) -> None:
    voxels, size = modules["voxels"], jnp.float32(0.0625)
    points = jnp.array([-0.0626, -0.0625, -0.01, 0.0, 0.0624, 0.0625, -1e9, 1e9])
    index = voxels.voxel_index(points, size)
    np.testing.assert_array_equal(index, [-2, -1, -1, 0, 0, 1, -(1 << 20), (1 << 20) - 1])
    np.testing.assert_array_equal(voxels.voxel_center(index[1:3], size), [-0.03125, -0.03125])


def law_nearest(modules: Modules) -> None:
    sphere = modules["sphere"]
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


def law_angle(modules: Modules) -> None:
    bins = modules["sphere"].bins_for_angle
    for angle, num in ((10.0, 526), (120.0, 4), (360.0, 1)):
        assert bins(angle) == num


def law_camera(modules: Modules) -> None:
    cameras = modules["cameras"]
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


def law_pose(modules: Modules) -> None:
    cameras = modules["cameras"]
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


def law_safe(modules: Modules) -> None:
    numerics = modules["numerics"]
    zero = jnp.zeros(())
    assert float(numerics.safe_power(zero, zero)) == 1.0
    assert float(numerics.safe_power(zero, zero + 2.0)) == 0.0
    np.testing.assert_allclose(numerics.safe_power(zero + 2.0, zero + 3.0), 8.0, rtol=1e-6)
    np.testing.assert_allclose(numerics.safe_norm(jnp.array([3.0, 4.0])), 5.0)
    assert float(numerics.safe_divide(zero + 1.0, zero)) == 0.0
    gradients = [
        *jax.grad(numerics.safe_power, argnums=(0, 1))(zero, zero + 0.5),
        *jax.grad(numerics.safe_divide, argnums=(0, 1))(zero + 1.0, zero),
        *jax.grad(numerics.safe_norm)(jnp.zeros(2)),
    ]
    assert np.isfinite(gradients).all()


LAWS = (law_packing, law_index, law_nearest, law_angle, law_camera, law_pose, law_safe)
CHAIN = tuple(f"r3jax.geometry.{name}" for name in ("numerics", "voxels", "sphere", "cameras"))
MUTANTS = [
    Mutant("voxels", "low = ux | (uy << 21)", "low = ux | (uy << 20)", law_packing),
    Mutant("voxels", "high = (uy >> 11) | (uz << 10)", "high = (uz << 10)", law_packing),
    Mutant("voxels", "u.astype(jnp.int32) - INDEX_LIMIT", "u.astype(jnp.int32)", law_packing),
    Mutant("voxels", "jnp.floor(coordinates / voxel_size)",
           "jnp.trunc(coordinates / voxel_size)", law_index),
    Mutant("voxels", "limit - 1.0", "limit", law_index),
    Mutant("voxels", "astype(jnp.float32) + 0.5", "astype(jnp.float32)", law_index),
    Mutant("sphere", "2.0 * (k + 0.5) / num", "2.0 * k / num", law_nearest),
    Mutant("sphere", "np.pi * k / GOLDEN_RATIO", "np.pi * k * GOLDEN_RATIO * 1.01", law_nearest),
    Mutant("sphere", "nearest + 2.0 * radius", "nearest", law_nearest),
    Mutant("sphere", "is_better = cosine > best", "is_better = cosine < best", law_nearest),
    Mutant("sphere", "math.radians(angle_deg)))", "math.radians(2 * angle_deg)))", law_angle),
    Mutant("sphere", "math.pi / cap - 1e-9)", "math.pi / cap + 1e-9)", law_angle),
    Mutant("cameras", "jnp.float32) + 0.5 - camera.cx",
           "jnp.float32) - camera.cx", law_camera),
    Mutant("cameras", "camera.fy * y / z_safe", "camera.fx * y / z_safe", law_camera),
    Mutant("cameras", "focal = 0.5 * width", "focal = width", law_camera),
    Mutant("cameras", "T[:3, :3].T", "T[:3, :3]", law_pose),
    Mutant("cameras", "t_inverse = -R_inverse", "t_inverse = R_inverse", law_pose),
    Mutant("cameras", "jnp.stack([forward[1], -forward[0],",
           "jnp.stack([-forward[1], forward[0],", law_pose),
    Mutant("cameras", "jnp.where(is_vertical, jnp.array([1.0, 0.0, 0.0]), right / length_safe)",
           "right / length_safe", law_pose),
    Mutant("cameras", "jnp.cross(forward, right)", "jnp.cross(right, forward)", law_pose),
    Mutant("cameras", '"ij,...j->...i"', '"ji,...j->...i"', law_pose),
    Mutant("numerics", "jnp.where(exponent == 0.0, 1.0, 0.0)", "0.0 * exponent", law_safe),
    Mutant("numerics", "jnp.where(is_zero, 1.0, base)", "base", law_safe),
    Mutant("numerics", "jnp.where(is_zero, 1.0, squared)", "squared", law_safe),
    Mutant("numerics", "jnp.where(is_zero, 1.0, denominator)", "denominator", law_safe),
]  # fmt: skip


def test_laws_hold_without_a_fault():
    modules = load(CHAIN)
    for law in LAWS:
        law(modules)


@each(MUTANTS)
def test_mutant_is_caught(mutant):
    assert_caught(CHAIN, mutant)
