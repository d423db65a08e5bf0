"""Faults in voxels, directions, cameras and numbers."""

from tests.mutants import faults

MUTANTS = [
    *faults(
        "r3jax/geometry/voxels.py",
        "tests/geometry/test_formulas.py::test_packing",
        ("low = ux | (uy << 21)", "low = ux | (uy << 20)"),
        ("high = (uy >> 11) | (uz << 10)", "high = (uz << 10)"),
        ("u.astype(jnp.int32) - INDEX_LIMIT", "u.astype(jnp.int32)"),
    ),
    *faults(
        "r3jax/geometry/voxels.py",
        "tests/geometry/test_formulas.py::test_index",
        ("jnp.floor(coordinates / voxel_size)", "jnp.trunc(coordinates / voxel_size)"),
        ("limit - 1.0", "limit"),
        ("astype(jnp.float32) + 0.5", "astype(jnp.float32)"),
    ),
    *faults(
        "r3jax/geometry/sphere.py",
        "tests/geometry/test_formulas.py::test_nearest",
        ("2.0 * (k + 0.5) / num", "2.0 * k / num"),
        ("np.pi * k / GOLDEN_RATIO", "np.pi * k * GOLDEN_RATIO * 1.01"),
        ("nearest + 2.0 * radius", "nearest"),
        ("is_better = cosine > best", "is_better = cosine < best"),
    ),
    *faults(
        "r3jax/geometry/cameras.py",
        "tests/geometry/test_formulas.py::test_camera",
        ("jnp.float32) + 0.5 - camera.cx", "jnp.float32) - camera.cx"),
        ("camera.fy * y / z_safe", "camera.fx * y / z_safe"),
        ("focal = 0.5 * width", "focal = width"),
    ),
    *faults(
        "r3jax/geometry/cameras.py",
        "tests/geometry/test_formulas.py::test_pose",
        ("T[:3, :3].T", "T[:3, :3]"),
        ("t_inverse = -R_inverse", "t_inverse = R_inverse"),
        ("jnp.stack([forward[1], -forward[0],", "jnp.stack([-forward[1], forward[0],"),
        (
            "jnp.where(is_vertical, jnp.array([1.0, 0.0, 0.0]), right / length_safe)",
            "right / length_safe",
        ),
        ("jnp.cross(forward, right)", "jnp.cross(right, forward)"),
        ('"ij,...j->...i"', '"ji,...j->...i"'),
    ),
    *faults(
        "r3jax/geometry/numerics.py",
        "tests/geometry/test_formulas.py::test_safe",
        ("jnp.where(exponent == 0.0, 1.0, 0.0)", "0.0 * exponent"),
        ("jnp.where(is_zero, 1.0, base)", "base"),
        ("jnp.where(is_zero, 1.0, squared)", "squared"),
    ),
]
