"""Frames join the map: the pixels that take part, and no other, against float64.

The camera and its poses are such that float32 holds all points exactly: no rounding decides
which voxel a point is in, and the reference can be exact about it.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.mapping import update as real
from r3jax.mapping.associate import edge_pixels, points_of_pixels
from r3jax.mapping.state import MapState
from r3jax.mapping.update import integrate, integrate_growing, integrate_points
from tests.mapping.reference import ReferenceMap, assert_same_rows, read_map
from tests.mapping.sighted import NUM_BINS, assert_identical_rows, new_map
from tests.strategies import VOXEL_SIZE

HEIGHT, WIDTH, CAPACITY = 12, 16, 512  # one shape: one compile
CAMERA = Camera(WIDTH, HEIGHT, 16.0, 32.0, 7.5, 6.5)  # nothing square, nothing centered
TURNS = {
    "x": np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]),
    "-x": np.array([[0, 0, -1], [1, 0, 0], [0, -1, 0]]),
    "down": np.array([[1, 0, 0], [0, -1, 0], [0, 0, -1]]),
}
"""Rotations camera to world, named by where the camera looks."""


def frame_of(depth: np.ndarray, turn: str = "x", seed: int = 0) -> Frame:
    """A frame of random colors; the camera stands at a multiple of 1/1024 m."""
    random = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = TURNS[turn]
    T[:3, 3] = (random.integers(-512, 512, 3) + 0.25) / 256
    rgb = random.random((HEIGHT, WIDTH, 3)).astype(np.float32)
    return Frame(rgb=rgb, depth=depth, T_world_camera=T, camera=CAMERA)


def scene_depth(seed: int = 0) -> np.ndarray:
    """Steps, a slope of whole voxels, holes and pixels out of range; multiples of 1/16 m."""
    random = np.random.default_rng(seed)
    depth = np.full((HEIGHT, WIDTH), 1.5, np.float32)
    depth[:, 9:] = 2.25
    depth[8:] += np.arange(WIDTH, dtype=np.float32) / 16
    depth[random.random(depth.shape) < 0.1] = 0.0
    depth[:3, 12:] = np.inf
    return depth


def reference_of(frames: list[Frame], takes_part: list[np.ndarray]) -> ReferenceMap:
    """The map as a dictionary, in float64, of the pixels that are said to take part."""
    reference = ReferenceMap(VOXEL_SIZE, NUM_BINS)
    for frame, mask in zip(frames, takes_part, strict=True):
        depth, T = np.float64(frame.depth)[mask], np.float64(frame.T_world_camera)
        row, column = np.nonzero(mask)
        x = (column + 0.5 - float(CAMERA.cx)) / float(CAMERA.fx) * depth
        y = (row + 0.5 - float(CAMERA.cy)) / float(CAMERA.fy) * depth
        points = np.stack([x, y, depth], axis=1) @ T[:3, :3].T + T[:3, 3]
        focal = np.sqrt(float(CAMERA.fx) * float(CAMERA.fy))
        reference.see(points, np.asarray(frame.rgb)[mask], T[:3, 3], focal)
    return reference


def pixels_of(module):
    """The part of `integrate` that the pixels decide, which the reference knows."""
    update = jax.jit(module.integrate_pixels)

    def add(state, frame, max_range=np.inf, drop_edges=True):
        return update(state, frame, jnp.float32(max_range), jnp.asarray(drop_edges))

    return add


PIXELS = pixels_of(real)


def map_of(frames: list[Frame], add=PIXELS, **options) -> MapState:
    state = new_map(CAPACITY)
    for frame in frames:
        state = add(state, frame, **options)
    return state


def is_measured(frame: Frame) -> np.ndarray:
    return np.isfinite(frame.depth) & (np.asarray(frame.depth) > 0.0)


def is_edge(frame: Frame) -> np.ndarray:
    return np.asarray(edge_pixels(frame.depth, jnp.float32(VOXEL_SIZE)))


FRAMES = [frame_of(scene_depth(i), turn, seed=i) for i, turn in enumerate(TURNS)]


def test_frame_equals_its_points():
    frame = FRAMES[0]
    seen = is_measured(frame)
    points = np.asarray(points_of_pixels(frame, frame.depth)).T[seen.reshape(-1)]
    rgb = np.asarray(frame.rgb)[seen]
    alone = integrate_points(new_map(CAPACITY), points, rgb, frame.position, CAMERA.focal)
    assert_same_rows(read_map(map_of([frame], drop_edges=False)), read_map(alone))


def test_frame_equals_the_scan_of_a_sensor_that_stands_still():
    """Every pixel is a ray, those without a measurement are padding, one position for each."""
    frame = FRAMES[1]
    points = points_of_pixels(frame, jnp.where(is_measured(frame), frame.depth, jnp.nan)).T
    rgb = frame.rgb.reshape(-1, 3)
    positions = jnp.broadcast_to(frame.position, points.shape)
    valid = is_measured(frame).reshape(-1)
    scan = integrate_points(new_map(CAPACITY), points, rgb, positions, CAMERA.focal, valid=valid)
    assert_same_rows(read_map(map_of([frame], drop_edges=False)), read_map(scan))


def test_order_of_frames_does_not_matter():
    assert_same_rows(read_map(map_of(FRAMES[::-1])), read_map(map_of(FRAMES)))


def test_the_same_frame_again_adds_observations_but_no_noise():
    once, twice = read_map(map_of(FRAMES[:1])), read_map(map_of([FRAMES[0]] * 2))
    assert once.keys() == twice.keys()
    for voxel, row in twice.items():
        assert (row.count, row.bins) == (2.0, once[voxel].bins)
        assert row.m2 < 1e-10
        np.testing.assert_allclose(row.mean, once[voxel].mean, atol=1e-6)


@pytest.mark.parametrize("depth", [0.0, np.inf])
def test_a_frame_without_measurements_changes_nothing(depth):
    before = map_of(FRAMES)
    after = PIXELS(before, frame_of(np.full((HEIGHT, WIDTH), depth, np.float32)))
    jax.tree.map(np.testing.assert_array_equal, after, before)


def test_integrate_under_jit_and_vmap_is_the_same():
    start = map_of(FRAMES[:1])
    one_by_one = [integrate(start, frame) for frame in FRAMES]
    assert_identical_rows(jax.jit(integrate)(start, FRAMES[1]), one_by_one[1])
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *FRAMES)
    together = jax.vmap(integrate, in_axes=(None, 0))(start, stacked)
    for i, alone in enumerate(one_by_one):
        of_frame = jax.tree.map(lambda leaf, i=i: leaf[i], together)
        assert_same_rows(read_map(of_frame), read_map(alone))


def test_frames_scan_into_a_map():
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *FRAMES)
    step = lambda state, frame: (integrate(state, frame), None)
    scanned, _ = jax.lax.scan(step, new_map(CAPACITY), stacked)
    assert_same_rows(read_map(scanned), read_map(map_of(FRAMES, integrate)))


def test_sweeps_over_numbers_compile_once():
    sweep = jax.jit(lambda *arguments: integrate(*arguments))
    for size, max_range, drop in [(0.0625, 5.0, True), (0.1, 2.0, False), (0.3, np.inf, True)]:
        sweep(new_map(CAPACITY, size), FRAMES[0], jnp.float32(max_range), jnp.asarray(drop))
    assert sweep._cache_size() == 1
    integrate(new_map(CAPACITY, 0.07), FRAMES[1], 4.0, True)
    # With what earlier tests of the process needed.
    compiled = real._integrate_in_place._cache_size()
    for size, max_range, drop in [(0.2, 3, False), (0.4, jnp.float32(2), True)]:
        integrate(new_map(CAPACITY, size), FRAMES[1], max_range, drop)
    assert real._integrate_in_place._cache_size() == compiled


def test_a_map_may_be_updated_in_place():
    state = new_map(CAPACITY)
    for frame in FRAMES:
        state = integrate(state, frame, donate=True)
    assert_identical_rows(state, map_of(FRAMES, integrate))


@pytest.mark.parametrize("capacity", [64, 1024])  # it must grow; it has room
def test_a_map_that_grows_may_be_updated_in_place(capacity):
    kept = given = new_map(capacity)
    for frame in FRAMES:
        kept, given = integrate_growing(kept, frame), integrate_growing(given, frame, donate=True)
        assert int(given.dropped) == 0
    assert kept.capacity == given.capacity
    assert_identical_rows(kept, given)


def test_a_map_that_is_not_given_away_stays():
    before = map_of(FRAMES[:1], integrate)
    rows = jax.tree.map(np.array, before)
    integrate(before, FRAMES[1])
    jax.tree.map(np.testing.assert_array_equal, before, rows)


@pytest.mark.parametrize("max_range", [0.0, -1.0, np.nan])
def test_bad_range_is_named(max_range):
    with pytest.raises(ValueError, match="max_range"):
        integrate(new_map(CAPACITY), FRAMES[0], max_range)


# Laws of fixed examples ---------------------------------------------------------------------------


def test_map_holds_the_statistics_of_all_frames() -> None:
    """All that was measured, edges and all; nothing else."""
    measured = [is_measured(frame) for frame in FRAMES]
    reference = reference_of(FRAMES, measured)
    assert reference.clearance > 1e-6
    state = map_of(FRAMES, pixels_of(real), drop_edges=False)
    assert_same_rows(read_map(state), reference.rows())


def test_edges_take_no_part_unless_they_are_let_in() -> None:
    frame = FRAMES[0]
    measured = is_measured(frame)
    edges = is_edge(frame)
    assert 0.1 < edges.mean() < 0.7
    inside = reference_of([frame], [measured & ~edges]).rows()
    assert len(inside) < len(reference_of([frame], [measured]).rows())
    assert_same_rows(read_map(map_of([frame], pixels_of(real))), inside)


def test_range_ends_at_z_depth_and_includes_its_end() -> None:
    """1.5 m is the depth of the nearest surface, whatever the length of its rays."""
    near = [np.asarray(frame.depth) == 1.5 for frame in FRAMES]
    options = {"max_range": 1.5, "drop_edges": False}
    state = map_of(FRAMES, pixels_of(real), **options)
    assert_same_rows(read_map(state), reference_of(FRAMES, near).rows())


def test_a_camera_whose_surroundings_have_no_voxel_index_is_refused():
    state = new_map(CAPACITY)
    small = dataclasses.replace(state, voxel_size=jnp.float32(0.01))
    frame = frame_of(scene_depth())
    far = frame.T_world_camera.at[0, 3].set(12_000.0)
    moved = dataclasses.replace(frame, T_world_camera=far)
    integrate(state, moved)
    with pytest.raises(ValueError, match=r"12,000 m.*10,381 m"):
        integrate(small, moved)
