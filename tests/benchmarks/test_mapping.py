"""How long a frame takes to join the map, and that it stays so. Run by `make benchmark`."""

import jax
import pytest

import r3jax

pytestmark = pytest.mark.full

KEY_FRAMES = [20, pytest.param(300, marks=pytest.mark.measured)]


def test_integrate(benchmark, explored):
    """Target: 12 ms for a 512x512 frame."""
    frame = explored.frames[-1]
    update = lambda: jax.block_until_ready(r3jax.integrate(explored.map, frame))
    update()
    after = benchmark(update)
    assert int(after.dropped) == 0


def test_bytes_per_row(explored):
    """Target: 48."""
    assert explored.map.bytes_per_row <= 48


@pytest.mark.parametrize("key_frames", KEY_FRAMES)
def test_update_at_key_frame(benchmark, explored, key_frames):
    """Target: 300 costs at most 1.1 times what 20 costs, with the same voxels in view."""
    state, frame = explored.map, explored.frames[-1]
    for _ in range(key_frames - len(explored.frames)):
        state = r3jax.integrate(state, frame)
    update = lambda: jax.block_until_ready(r3jax.integrate(state, frame))
    update()
    benchmark(update)


@pytest.mark.parametrize("key_frames", KEY_FRAMES)
def test_query_at_key_frame(benchmark, explored, scoring, key_frames):
    """Target: 300 costs at most 1.1 times what 20 costs, with the same voxels in view."""
    state, frame = explored.map, explored.frames[-1]
    for _ in range(key_frames - len(explored.frames)):
        state = r3jax.integrate(state, frame)
    query = lambda: jax.block_until_ready(
        r3jax.view_utility(state, explored.grid, explored.camera, explored.pose, scoring)
    )
    query()
    benchmark(query)
