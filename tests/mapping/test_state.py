"""An empty map: its size in memory, and what it refuses."""

import jax
import numpy as np
import pytest

from r3jax.mapping.state import empty_map


@pytest.mark.parametrize("num_bins", [1, 32, 33, 64])
def test_empty_map_has_seen_nothing(num_bins):
    state = empty_map(64, 0.1, num_bins)
    assert state.capacity == 64
    assert int(state.num_occupied) == int(state.dropped) == 0
    assert not np.asarray(state.occupied).any()
    assert state.visited.shape == (-(-num_bins // 32), 64)
    for rows in (state.visited, state.count, state.mean, state.m2, state.resolution):
        assert not np.asarray(rows).any()


def test_a_row_takes_at_most_48_bytes():
    state = empty_map()
    assert state.bytes_per_row <= 48
    arrays = sum(leaf.nbytes for leaf in jax.tree.leaves(state))
    assert arrays == state.bytes_per_row * state.capacity + 8  # the voxel size and `dropped`
    assert arrays <= 10e6


@pytest.mark.parametrize("capacity", [0, -4, 1, 3, 100, (1 << 17) + 1])
def test_bad_capacity_is_refused(capacity):
    with pytest.raises(ValueError, match=f"capacity.*{capacity}"):
        empty_map(capacity)


@pytest.mark.parametrize("voxel_size", [0.0, -0.05, float("nan"), float("inf")])
def test_bad_voxel_size_is_refused(voxel_size):
    with pytest.raises(ValueError, match="voxel_size"):
        empty_map(16, voxel_size)


@pytest.mark.parametrize("num_bins", [0, -64])
def test_no_bins_are_refused(num_bins):
    with pytest.raises(ValueError, match=f"num_bins.*{num_bins}"):
        empty_map(16, num_bins=num_bins)
