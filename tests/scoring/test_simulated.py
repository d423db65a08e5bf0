"""Views that nobody took: nothing falls by them, and their order does not matter."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from r3jax.geometry.cameras import Camera, look_at
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.geometry.voxels import unpack, voxel_center
from r3jax.mapping.state import MapState, empty_map
from r3jax.mapping.update import integrate_points
from r3jax.scoring import simulated as real
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.renderability import voxel_renderability
from r3jax.scoring.terms import consistency

CAPACITY, VOXEL = 1024, 0.1  # one shape: one compile
CAMERA = Camera(32, 24, 20.0, 20.0, 16.0, 12.0)
CONFIG = ScoringConfig(max_range=5.0)
seeds = st.integers(0, 1000)


def seen_map(seed: int = 0) -> MapState:
    """A wall at x = 2 and a plate before a part of it, seen from three places in odd colors."""
    rng = np.random.default_rng(seed)
    y, z = (a.ravel() for a in np.meshgrid(np.arange(-0.8, 0.8, 0.05), np.arange(-0.6, 0.6, 0.05)))
    wall = np.stack([np.full_like(y, 2.05), y, z], axis=1)
    plate = np.stack([np.full_like(y, 1.35), y, z], axis=1)[(y > 0.2) & (z > 0.0)]
    points = np.concatenate([wall, plate])
    state = empty_map(CAPACITY, VOXEL)
    for _ in range(3):
        eye = np.array([0.3, 0.0, 0.0]) + rng.uniform(-0.6, 0.6, 3)
        kept = rng.random(len(points)) < 0.6
        rgb = rng.uniform(0.2, 0.8, (len(points), 3))
        state = integrate_points(
            state, np.where(kept[:, None], points, points[:1]).astype(np.float32),
            rgb.astype(np.float32), eye.astype(np.float32), 20.0,
        )  # fmt: skip
    return state


def poses_of(seed: int, num: int = 2) -> list[jax.Array]:
    rng = np.random.default_rng([seed, 7])
    eyes = rng.uniform([-0.5, -1.0, -0.6], [0.9, 1.0, 0.6], (num, 3))
    targets = rng.uniform([2.0, -0.7, -0.5], [2.0, 0.7, 0.5], (num, 3))
    return [look_at(eye, target) for eye, target in zip(eyes, targets, strict=True)]


def value_from(state: MapState, position) -> np.ndarray:
    return np.asarray(voxel_renderability(state, position, 20.0).value)


def law_value(seed: int = 0) -> None:
    before = seen_map(seed)
    rng = np.random.default_rng([seed, 1])
    after = before
    for pose in poses_of(seed):
        after, _ = real.simulate_view(after, CAMERA, pose, CONFIG)
    for position in rng.uniform([-0.5, -1.5, -1], [1.2, 1.5, 1], (3, 3)).astype(np.float32):
        low, high = value_from(before, position), value_from(after, position)
        assert (high >= low - 1e-5).all()
    # And where the view was taken, something is seen better.
    taken = np.asarray(pose)[:3, 3]
    assert (value_from(after, taken) > value_from(before, taken)).any()


@given(seeds)
def test_no_renderability_falls(seed):
    law_value(seed)


def law_order(seed: int = 0) -> None:
    before, (first, second) = seen_map(seed), poses_of(seed)
    simulate_view = real.simulate_view
    one = simulate_view(simulate_view(before, CAMERA, first, CONFIG)[0], CAMERA, second, CONFIG)[0]
    other = simulate_view(simulate_view(before, CAMERA, second, CONFIG)[0], CAMERA, first, CONFIG)[
        0
    ]
    for name in ("visited", "resolution", "count", "key", "mean", "dropped"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    np.testing.assert_allclose(one.m2, other.m2, rtol=1e-6)


@given(seeds)
def test_the_order_does_not_matter(seed):
    law_order(seed)


def law_observation(seed: int = 0) -> None:
    """What each voxel gains, worked out voxel by voxel in double precision."""
    before, pose = seen_map(seed), poses_of(seed)[0]
    after, shown = real.simulate_view(before, CAMERA, pose, CONFIG)
    shown = np.asarray(shown)
    present = np.asarray(before.occupied)
    assert 20 < shown.sum() <= present.sum()
    assert not shown[~present].any()
    index = jnp.stack(unpack(before.key[0], before.key[1]))
    offset = np.float64(pose)[:3, 3, None] - np.float64(voxel_center(index, before.voxel_size))
    distance = np.linalg.norm(offset, axis=0)
    bins = np.argmax(np.float64(fibonacci_lattice(64)) @ offset, axis=0)
    bit = np.zeros((2, CAPACITY), np.uint32)
    bit[bins // 32, np.arange(CAPACITY)] = np.uint32(1) << (bins % 32).astype(np.uint32)
    expected = np.asarray(before.visited) | np.where(shown, bit, 0)
    np.testing.assert_array_equal(after.visited, expected)
    best = np.maximum(np.asarray(before.resolution), np.where(shown, 20.0 / distance, 0.0))
    np.testing.assert_allclose(after.resolution, best, rtol=1e-5)
    np.testing.assert_array_equal(after.count, np.asarray(before.count) + shown)
    np.testing.assert_allclose(
        consistency(after.count, after.m2), consistency(before.count, before.m2), atol=1e-5
    )


@given(seeds)
def test_bins_counts_and_resolution_are_those_of_a_view_that_agrees(seed):
    law_observation(seed)


def test_what_is_hidden_is_not_foreseen() -> None:
    """The wall behind the plate is not observed, the wall beside it is."""
    before = seen_map()
    pose = look_at(np.zeros(3), np.array([2.0, 0.0, 0.0]))
    _, shown = real.simulate_view(before, CAMERA, pose, CONFIG)
    index = jnp.stack(unpack(before.key[0], before.key[1]))
    x, y, z = np.asarray(voxel_center(index, before.voxel_size))
    is_wall = np.asarray(before.occupied) & (x > 1.8)
    behind = is_wall & (y > 0.5) & (z > 0.25) & (y < 0.75) & (z < 0.5)
    beside = is_wall & (y < 0.0) & (z < 0.0)
    assert behind.sum() > 2
    assert not np.asarray(shown)[behind].any()
    assert np.asarray(shown)[beside].mean() > 0.9
