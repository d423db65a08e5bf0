"""A capture mapped neighborhood by neighborhood: against one map of all frames."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r3jax.apps.select.observations import observe
from r3jax.apps.select.targets import see_targets
from r3jax.captures import neighborhoods
from r3jax.captures.capture_maps import blank, join_on_rows, map_of_all
from r3jax.captures.neighborhoods import divided
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.mapping.state import empty_map
from r3jax.mapping.update import integrate_growing
from tests.captures.test_capture_maps import assert_same

RANGE, VOXEL = 1.0, 0.1
"""A short range, so that a walk of a few meters leaves neighborhoods behind."""

CAMERA = Camera(24, 18, 12.0, 12.0, 12.0, 9.0)
seeds = st.integers(0, 1 << 16)


def walk(seed: int, num: int = 12) -> list[Frame]:
    """Frames in a volume of 9 x 9 x 2 m, of level surfaces at chance depths, with holes."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(num):
        pose = np.eye(4)
        pose[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        pose[:3, :3] *= np.linalg.det(pose[:3, :3])
        pose[:3, 3] = rng.uniform(0.0, [9.0, 9.0, 2.0])
        depth = np.repeat(rng.uniform(0.3, 1.2, (9, 12)), 2, 0).repeat(2, 1).astype(np.float32)
        depth[rng.random(depth.shape) < 0.1] = 0.0
        rgb = rng.random((18, 24, 3), dtype=np.float32)
        T = jnp.asarray(pose, jnp.float32)
        found.append(Frame(jnp.asarray(rgb), jnp.asarray(depth), T, CAMERA))
    return found


def eyes_of(frames: list[Frame]) -> np.ndarray:
    return np.stack([np.asarray(frame.position) for frame in frames])


def mapped(frames: list[Frame]):
    groups = divided(eyes_of(frames), RANGE)
    ordered = iter([frames[i] for i in np.concatenate(groups)])
    return groups, map_of_all(ordered, groups, VOXEL, max_range=RANGE)


def seen_by_each(frames: list[Frame], whole):
    reach, edges = jnp.float32(RANGE), jnp.asarray(True)
    join = lambda part, all_rows, frame: join_on_rows(part, all_rows, frame, reach, edges, reach)
    cameras = [frame.camera for frame in frames]
    read = frames.__getitem__
    return observe(whole, read, eyes_of(frames), cameras, join, max_range=RANGE)


@given(seeds)
@settings(max_examples=10)
def test_the_map_is_that_of_all_frames_one_after_the_other(seed):
    frames = walk(seed)
    groups, whole = mapped(frames)
    assert len(groups) > 3
    assert sorted(np.concatenate(groups)) == list(range(len(frames)))
    plain = empty_map(1 << 12, VOXEL)
    for frame in frames:
        plain = integrate_growing(plain, frame, RANGE)
    assert_same(whole, plain)


@given(seeds)
@settings(max_examples=10)
def test_a_frame_observes_and_a_view_shows_what_it_does_on_the_whole_map(seed):
    frames = walk(seed)
    _, whole = mapped(frames)
    poses = np.stack([np.asarray(frame.T_world_camera) for frame in frames])
    cameras = [frame.camera for frame in frames]
    own = seen_by_each(frames, whole)
    targets = see_targets(whole, own, cameras, poses, RANGE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(neighborhoods, "_TOGETHER", 1e9)
        assert len(divided(eyes_of(frames), RANGE)) == 1
        all_at_once = seen_by_each(frames, whole)
        same_targets = see_targets(whole, all_at_once, cameras, poses, RANGE)
    for name in ("key", "first", "row", "is_colored", "position"):
        np.testing.assert_array_equal(getattr(own, name), getattr(all_at_once, name))
    for name in ("resolution", "color"):
        a, b = getattr(own, name), getattr(all_at_once, name)
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)
    for name in ("first", "target", "weight"):
        np.testing.assert_array_equal(getattr(targets, name), getattr(same_targets, name))


def test_rows_that_are_taken_and_put_back_change_nothing_else():
    frames = walk(3)
    _, whole = mapped(frames)
    nearby = neighborhoods.neighborhoods(whole, eyes_of(frames), [CAMERA], RANGE)
    shares = []
    for near in nearby:
        shares.append(near.state.num_occupied / whole.num_occupied)
        state = blank(whole)
        part = near.part_of(whole)
        np.testing.assert_array_equal(part.count, near.state.count)
        np.testing.assert_array_equal(part.visited, near.state.visited)
        is_near = np.isin(np.arange(whole.capacity), near.row)
        after = near.put_into(state, part)
        np.testing.assert_array_equal(after.count, np.where(is_near, whole.count, 0.0))
        np.testing.assert_array_equal(after.mean, np.where(is_near, whole.mean, 0.0))
        np.testing.assert_array_equal(np.append(whole.m2, np.float32(0.0))[near.row], part.m2)
    assert max(shares) < 0.9
