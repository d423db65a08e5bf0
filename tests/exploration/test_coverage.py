"""Coverage: counts against a second way of counting, probes where a camera could be."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.exploration.coverage import measure_coverage, probe_poses
from r3jax.geometry.cameras import Camera, pose_along, rigid_error
from r3jax.mapping.occupancy import empty_grid
from r3jax.mapping.state import empty_map

BOX = np.array([[0.0, 0.0, 0.0], [2.0, 2.0, 2.0]])


def make_grid(free_until: int):
    """The first layers along x are free, the last one is occupied, the rest is unexplored."""
    grid = empty_grid(BOX, 0.2)
    values = np.zeros(grid.log_odds.shape, np.float32)
    values[:free_until] = -4.0
    values[-1] = 4.0
    return eqx.tree_at(lambda g: g.log_odds, grid, jnp.asarray(values))


def test_counts_agree_with_counting_by_hand():
    coverage = measure_coverage(
        empty_map(64),
        make_grid(5),
        Camera.from_fov(16, 16),
        arrival_renderability=0.25,
        num_probes=4,
    )
    assert coverage.known_cells == 5 * 144 + 144
    assert coverage.known_share == pytest.approx(6 / 12)
    assert coverage.frontier_cells == 144
    assert (coverage.voxels, coverage.dropped) == (0, 0)
    assert coverage.map_bytes == 64 * empty_map(64).bytes_per_row
    assert (coverage.mean_renderability, coverage.arrival_renderability) == (0.0, 0.25)


def test_probes_lie_in_free_space_with_room_round_them():
    grid = make_grid(6)
    poses = probe_poses(grid, 16)
    assert poses.shape == (16, 4, 4)
    free = np.asarray(grid.free)
    for pose in poses:
        assert rigid_error(pose) is None
        cell = np.floor((pose[:3, 3] - np.asarray(grid.origin)) / 0.2).astype(int)
        around = free[tuple(slice(i - 1, i + 2) for i in cell)]
        assert around.shape == (3, 3, 3)
        assert around.all()


def test_probes_look_level_and_roll_free():
    for pose in probe_poses(make_grid(6), 8):
        again = pose_along(jnp.asarray(pose[:3, 3]), jnp.asarray(pose[:3, 2]))
        np.testing.assert_allclose(pose, again, atol=1e-5)
        assert abs(pose[2, 2]) <= np.sin(np.deg2rad(45)) + 1e-6


def test_more_free_space_keeps_the_old_probes():
    small, large = probe_poses(make_grid(5), 10_000), probe_poses(make_grid(9), 10_000)
    assert 0 < len(small) < len(large)
    assert {p.tobytes() for p in small} <= {p.tobytes() for p in large}


def test_nothing_known_means_no_probe():
    assert probe_poses(empty_grid(BOX), 8).shape == (0, 4, 4)
