"""Voxels that a frame looked at: against a loop in float64, and what must not change."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera, look_at
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.geometry.voxels import unpack, voxel_center
from r3jax.mapping import seen as real
from r3jax.mapping.state import MapState, empty_map
from r3jax.mapping.update import integrate, integrate_growing, integrate_points
from tests.tiers import quick_and_full

WIDTH, HEIGHT, CAPACITY, VOXEL = 24, 18, 2048, 0.05  # one shape: one compile
CAMERA = Camera(WIDTH, HEIGHT, 20.0, 22.0, 11.0, 9.5)
REACH = 3.0
mark = jax.jit(real.mark_seen)


def cloud_map(seed: int = 0) -> MapState:
    """Voxels strewn through a box, seen once from a corner."""
    points = np.random.default_rng(seed).uniform([-1, -1, -1], [3.5, 1, 1], (900, 3))
    return integrate_points(
        empty_map(CAPACITY, VOXEL),
        jnp.asarray(points, jnp.float32),
        jnp.full((900, 3), 0.5),
        jnp.array([-2.0, -1.5, 1.0]),
        jnp.float32(20.0),
    )


def frame_of(seed: int = 0) -> Frame:
    """A wall with a step, a slope, a hole and a part out of range, seen along x."""
    depth = np.full((HEIGHT, WIDTH), 1.6, np.float32)
    depth[:, 14:] = 2.4
    depth[12:] += np.arange(WIDTH, dtype=np.float32) / 8
    depth[2:5, 3:7] = 0.0
    depth[:2] = np.inf
    eye = np.random.default_rng(seed).uniform(-0.2, 0.2, 3)
    pose = look_at(jnp.asarray(eye, jnp.float32), jnp.array([3.0, 0.1, 0.0]))
    return Frame(rgb=np.zeros((HEIGHT, WIDTH, 3), np.float32), depth=depth,
                 T_world_camera=pose, camera=CAMERA)  # fmt: skip


def centers_of(state: MapState) -> np.ndarray:
    return np.float64(voxel_center(jnp.stack(unpack(state.key[0], state.key[1])), state.voxel_size))


def seen_by_hand(state: MapState, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Which rows are seen, voxel by voxel, and which lie too near a limit to be sure of."""
    centers, T = centers_of(state), np.linalg.inv(np.float64(frame.T_world_camera))
    depth = np.asarray(frame.depth)
    seen, unsure = np.zeros(CAPACITY, bool), np.zeros(CAPACITY, bool)
    for row in np.flatnonzero(np.asarray(state.occupied)):
        x, y, z = T[:3, :3] @ centers[:, row] + T[:3, 3]
        if z <= 1e-3:
            continue
        u, v = 20.0 * x / z + 11.0, 22.0 * y / z + 9.5
        reach = np.linalg.norm([x, y, z])
        unsure[row] = min(u % 1, 1 - u % 1, v % 1, 1 - v % 1) < 1e-3 or abs(reach - REACH) < 1e-3
        if not (0 <= u < WIDTH and 0 <= v < HEIGHT) or reach > REACH:
            continue
        i, j = int(v), int(u)
        around = depth[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2]
        limit = around.max() + VOXEL
        unsure[row] |= (
            abs(z - limit) < 1e-3 or depth[i, j] == 0
        )  # holes: `test_behind_glass_a_voxel_is_seen_unless_another_hides_it`
        seen[row] = z <= limit
    return seen, unsure


def bins_by_hand(state: MapState, frame: Frame) -> np.ndarray:
    """The bin of the lattice nearest to the direction from each voxel to the camera."""
    offset = np.float64(frame.position)[:, None] - centers_of(state)
    return np.argmax(np.float64(fibonacci_lattice(64)) @ offset, axis=0)


def has_bin(state: MapState, bins: np.ndarray) -> np.ndarray:
    words = np.asarray(state.visited)
    return (words[bins // 32, np.arange(CAPACITY)] >> (bins % 32).astype(np.uint32)) & 1 == 1


def law_seen() -> None:
    update = jax.jit(real.mark_seen)
    for seed in range(3):
        before, frame = cloud_map(seed), frame_of(seed)
        after = update(before, frame, REACH)
        seen, unsure = seen_by_hand(before, frame)
        bins = bins_by_hand(before, frame)
        fresh = ~has_bin(before, bins)
        sure = np.asarray(before.occupied) & ~unsure & fresh
        assert 50 < (seen & sure).sum() < sure.sum() - 50
        np.testing.assert_array_equal(has_bin(after, bins)[sure], seen[sure])
        distance = np.linalg.norm(np.float64(frame.position)[:, None] - centers_of(before), axis=0)
        best = np.maximum(np.asarray(before.resolution), float(CAMERA.focal) / distance)
        expected = np.where(seen, best, np.asarray(before.resolution))
        sure = np.asarray(before.occupied) & ~unsure
        np.testing.assert_allclose(np.asarray(after.resolution)[sure], expected[sure], rtol=1e-5)
        np.testing.assert_array_equal(
            np.bitwise_and(np.asarray(after.visited), np.asarray(before.visited)), before.visited
        )
        for name in ("key", "count", "mean", "m2", "dropped"):
            np.testing.assert_array_equal(getattr(after, name), getattr(before, name))


def test_what_is_seen_is_what_a_loop_says():
    law_seen()


def test_marking_twice_changes_nothing():
    once = mark(cloud_map(), frame_of(), REACH)
    twice = mark(once, frame_of(), REACH)
    jax.tree.map(np.testing.assert_array_equal, once, twice)


def test_behind_glass_a_voxel_is_seen_unless_another_hides_it() -> None:
    """Without a measurement, a wall is seen where no other wall hides it, and nothing is new."""
    across, up = np.arange(-0.6, 0.61, 0.04), np.arange(-0.4, 0.41, 0.04)
    y, z = (a.ravel() for a in np.meshgrid(across, up))
    far = np.stack([np.full_like(y, 2.525), y, z], axis=1)
    near = np.stack([np.full_like(y, 1.525), y, z], axis=1)[y > 0.02]
    points = np.concatenate([far, near])
    before = integrate_points(
        empty_map(CAPACITY, VOXEL),
        jnp.asarray(points, jnp.float32),
        jnp.full((len(points), 3), 0.5),
        jnp.array([5.0, -3.0, 1.0]),  # from behind: no bin of the views below
        jnp.float32(20.0),
    )
    centers, occupied = centers_of(before), np.asarray(before.occupied)
    pose = look_at(jnp.zeros(3), jnp.array([3.0, 0.0, 0.0]))
    depth = np.zeros((HEIGHT, WIDTH), np.float32)
    depth[:9] = 2.0  # the upper half has a measurement, between the walls
    depth[12] = 9.0  # one row of measurements says nothing of the holes beside it
    frame = Frame(rgb=np.zeros((HEIGHT, WIDTH, 3), np.float32), depth=depth,
                  T_world_camera=pose, camera=CAMERA)  # fmt: skip
    after = jax.jit(real.mark_seen)(before, frame, REACH)
    is_seen = has_bin(after, bins_by_hand(before, frame)) & occupied
    is_far, is_left = centers[0] > 2.0, centers[1] < 0.0
    high, low = (centers[2] * s > 0.06 * centers[0] for s in (1.0, -1.0))  # off the border row
    row = 9.5 - 22.0 * centers[2] / centers[0]
    inside = occupied & (np.abs(centers[2]) < 0.3) & (np.abs(row - 12.5) > 0.55)
    # The near wall covers y > 0; what lies up to 0.15 m beside its shadow is left open.
    clear, covered = is_far & (centers[1] < -0.15), is_far & (centers[1] > 0.2)
    for wall, where, expected in [
        (clear, low, True), (covered, low, False), (~is_far, low, True),
        (clear, high, False), (covered, high, False), (~is_far, high, True),
    ]:  # fmt: skip
        rows = inside & wall & where
        assert rows.sum() > 20
        assert np.mean(is_seen[rows]) == float(expected), (expected, rows.sum())
    assert not is_seen[occupied & is_left & ~is_far].any()
    np.testing.assert_array_equal(after.count, before.count)


@pytest.mark.parametrize("allow_growth", quick_and_full([True, False], [False]))
def test_look_integrates_marks_and_grows(allow_growth):
    frame = frame_of()
    small = empty_map(64, VOXEL)
    after = integrate_growing(small, frame, REACH, allow_growth=allow_growth)
    if not allow_growth:
        assert after.capacity == 64
        assert int(after.dropped) > 0
        return
    assert int(after.dropped) == 0
    assert int(after.num_occupied) <= 0.7 * after.capacity
    plain = integrate(empty_map(after.capacity, VOXEL), frame, REACH)
    assert int(after.num_occupied) == int(plain.num_occupied)
    assert float(after.count.sum()) == float(plain.count.sum())


@pytest.mark.full
def test_look_lets_edges_in_if_told():
    frame = frame_of()
    after = integrate_growing(empty_map(64, VOXEL), frame, REACH, drop_edges=False)
    plain = integrate(empty_map(after.capacity, VOXEL), frame, REACH, False)
    np.testing.assert_array_equal(after.count, plain.count)
    filtered = integrate(empty_map(after.capacity, VOXEL), frame, REACH)
    assert int(filtered.num_occupied) < int(after.num_occupied)
