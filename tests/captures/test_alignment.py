"""The audit's coordinates: there and back, upright whatever the capture calls up."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.captures import alignment as real
from r3jax.captures.alignment import Alignment, rotation_to_z, up_of
from r3jax.geometry.cameras import rigid_error
from tests.formats.colmap_models import random_pose, random_rotation

seeds = st.integers(0, 10_000)


def random_alignment(seed: int, kind: type[Alignment] = Alignment) -> Alignment:
    rng = np.random.default_rng(seed)
    return kind(random_rotation(rng), float(rng.uniform(0.1, 9.0)), rng.normal(0.0, 50.0, 3))


@given(seeds)
def test_points_and_poses_come_back(seed):
    found = random_alignment(seed, real.Alignment)
    rng = np.random.default_rng(seed)
    points = rng.normal(0.0, 20.0, (5, 3))
    np.testing.assert_allclose(found.points_back(found.points(points)), points, atol=1e-9)
    poses = np.stack([random_pose(seed + i) for i in range(3)])
    moved = found.poses(poses)
    for pose in moved:
        assert rigid_error(pose) is None
    np.testing.assert_allclose(found.poses_back(moved), poses, atol=1e-9)


@given(seeds)
def test_what_a_camera_sees_stays_where_it_is_in_the_image(seed):
    """Coordinates in the camera change by the scale only, so pixels do not change."""
    found = random_alignment(seed, real.Alignment)
    points = np.random.default_rng(seed).normal(0.0, 20.0, (5, 3))
    pose = random_pose(seed)
    in_camera = lambda points, T: (points - T[:3, 3]) @ T[:3, :3]
    before = in_camera(points, pose)
    after = in_camera(found.points(points), found.poses(pose[None])[0])
    np.testing.assert_allclose(after, found.scale * before, atol=1e-8)


@given(seeds)
def test_up_becomes_z_by_the_smallest_rotation(seed):
    up = np.random.default_rng(seed).normal(size=3)
    up /= np.linalg.norm(up)
    R = real.rotation_to_z(up)
    np.testing.assert_allclose(R @ up, [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) > 0
    # The trace tells the angle; no rotation from `up` to z has a larger one.
    assert np.trace(R) == pytest.approx(1.0 + 2.0 * up[2], abs=1e-6)


def test_axes_become_z_without_rounding():
    for name in ("x", "y", "z", "-x", "-y", "-z"):
        R = rotation_to_z(up_of(name))
        np.testing.assert_array_equal(R @ up_of(name), [0, 0, 1])
        assert set(np.abs(R).ravel()) == {0.0, 1.0}
    np.testing.assert_array_equal(rotation_to_z(up_of("y")) @ [1, 2, 3], [1, -3, 2])
    with pytest.raises(ValueError, match="up"):
        up_of("w")


def test_up_may_be_any_direction():
    np.testing.assert_allclose(up_of("0.3,-4,0"), np.array([0.3, -4.0, 0.0]) / np.hypot(0.3, 4.0))
    for nothing in ("1,2", "0,0,0", "nan,0,1", "1e999,0,0", "up", ""):
        with pytest.raises(ValueError, match="--up"):
            up_of(nothing)
