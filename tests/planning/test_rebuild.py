"""A planner rebuilt from corrected frames is one that has observed them in order."""

import threading
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
import pytest

import r3jax
from r3jax.errors import InputError
from tests.rooms_of_boxes import ROOM, frame_in_room, pose_at

CAMERA = r3jax.Camera.from_fov(64, 48, 70.0)
CONFIG = r3jax.MappingConfig(capacity=1 << 12)
PLACES = [(-1.5, 0.2 * i, 1.2) for i in range(6)]


def frames(shift: float) -> list[r3jax.Frame]:
    """Frames whose poses are off by a shift, as a drift makes it."""
    poses = [pose_at(place, 25.0 * i, -8.0) for i, place in enumerate(PLACES)]
    seen = [frame_in_room(CAMERA, T, noise=0.01, seed=i) for i, T in enumerate(poses)]
    for T in poses:
        T[:2, 3] += shift
    pairs = zip(seen, poses, strict=True)
    return [r3jax.Frame(f.rgb, f.depth, T, CAMERA) for f, T in pairs]


def observed(seen: list[r3jax.Frame], policy: str, config=CONFIG) -> r3jax.Planner:
    starts = [seen[0].T_world_camera]
    planner = r3jax.start(CAMERA, ROOM, policy, starts=starts, config=config)
    for frame in seen:
        planner = r3jax.observe(planner, frame)
    return planner


def rows_of(planner: r3jax.Planner) -> np.ndarray:
    """All that is known of each voxel, [n, k], in an order of its own."""
    m = planner.map_state
    columns = [m.key, m.visited, m.count[None], m.mean, m.m2[None], m.resolution[None]]
    table = np.concatenate([np.asarray(c, np.float64) for c in columns]).T
    table = table[np.asarray(m.present)]
    return table[np.lexsort(table[:, :2].T)]


@pytest.fixture(scope="module", params=["r3-pano", "frontier"])
def policy(request):
    return request.param


def test_it_equals_observing_the_corrected_frames(policy):
    drifted, corrected = observed(frames(0.3), policy), observed(frames(0.0), policy)
    assert drifted.map_state.capacity > CONFIG.capacity  # it has grown; so the new one need not
    # An iterator: frames may come from a disk.
    rebuilt = r3jax.rebuild(drifted, iter(frames(0.0)))
    np.testing.assert_allclose(rows_of(rebuilt), rows_of(corrected), rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(rebuilt.grid.log_odds, corrected.grid.log_odds)
    assert jax.tree.structure(rebuilt.policy_state) == jax.tree.structure(corrected.policy_state)
    same = lambda a, b: np.testing.assert_array_equal(a, b)
    jax.tree.map(same, rebuilt.policy_state, corrected.policy_state)
    assert rebuilt.map_state.capacity == drifted.map_state.capacity


def test_the_planner_that_is_given_may_be_used_meanwhile(policy):
    planner, corrected = observed(frames(0.3), policy), frames(0.0)
    before, begun, going_on = rows_of(planner), threading.Event(), threading.Event()

    def from_disk():
        yield corrected[0]
        begun.set()
        assert going_on.wait(60.0)
        yield from corrected[1:]

    with ThreadPoolExecutor(1) as thread:
        future = thread.submit(r3jax.rebuild, planner, from_disk())
        assert begun.wait(60.0)
        r3jax.observe(planner, corrected[0])
        going_on.set()
        rebuilt = future.result()
    np.testing.assert_array_equal(rows_of(planner), before)
    np.testing.assert_array_equal(rows_of(rebuilt), rows_of(r3jax.rebuild(planner, corrected)))


def test_what_is_wrong_with_a_frame_is_said():
    def broken():
        yield frames(0.0)[0]
        raise OSError("000001.png is truncated")

    planner = observed(frames(0.0)[:1], "random")
    with pytest.raises(OSError, match=r"000001\.png"):
        r3jax.rebuild(planner, broken())
    with pytest.raises(InputError):
        r3jax.rebuild(planner, [])
