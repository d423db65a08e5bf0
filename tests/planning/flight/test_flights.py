"""What flights show, against panoramas and imagined views, look by look."""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.mapping.occupancy import mark_free_ball
from r3jax.planning.policies.flight import OursPath
from r3jax.planning.policies.flight.flights import Sights, Tree, fly, sights_of
from r3jax.planning.policies.flight.policy import PathConfig
from r3jax.planning.registry import make_policy
from r3jax.planning.robot.travel import segment_is_inside
from r3jax.scoring.batch import cache_positions_near, score_positions
from r3jax.scoring.gather import gather_in_range
from r3jax.scoring.simulated import observed
from r3jax.scoring.terms import score_voxels
from r3jax.visibility.selection import select
from tests.planning.known_hall import CAMERA, EYE, SCORING, for_scoring, known

PLACES = np.array([[1.0, 0.9, 1.2], [1.4, 0.9, 1.2], [1.4, 1.3, 1.2], [1.0, 1.3, 1.2]])
FOCAL = float(CAMERA.focal)


def at_hand():
    state, grid = for_scoring()
    voxels, cells, _ = gather_in_range(state, grid, jnp.asarray(PLACES, jnp.float32), SCORING)
    return voxels, cells


def sights(*, is_gain: bool) -> Sights:
    places = jnp.asarray(PLACES, jnp.float32)
    _, kept = cache_positions_near(*at_hand(), CAMERA, places, SCORING)
    return sights_of(kept, *at_hand(), PLACES, CAMERA, SCORING, is_gain=is_gain)


def star() -> Tree:
    """Every place by itself, one frame away."""
    num = len(PLACES)
    return Tree(np.arange(num), np.zeros(num, np.int64), np.full(num, 0.4), np.full(num, 0.4))


def chain() -> Tree:
    """One after the other, one frame at each."""
    num = len(PLACES)
    return Tree(np.arange(num), np.arange(num), np.full(num, 0.4), 0.4 * np.arange(1, num + 1))


def test_one_look_is_worth_what_the_panorama_says():
    panoramas = score_positions(*for_scoring(), CAMERA, PLACES, SCORING)
    gains, axes, adds = fly(sights(is_gain=False), star(), 0.4)
    np.testing.assert_allclose(gains, panoramas.best_score, rtol=1e-4)
    np.testing.assert_array_equal(adds, gains)
    of_axis = np.take_along_axis(np.asarray(panoramas.direction_scores), axes[:, None], 1)[:, 0]
    np.testing.assert_allclose(of_axis, panoramas.best_score, rtol=1e-4)


@pytest.mark.parametrize("k", range(len(PLACES)))
def test_a_gain_is_what_an_imagined_view_makes_of_R(k: int):
    voxels, _ = at_hand()
    begin, item, _, low, high = sights(is_gain=True).lists
    part = slice(begin[k], begin[k + 1])
    is_voxel = item[part] < voxels.capacity
    seen, place = item[part][is_voxel], jnp.asarray(PLACES[k], jnp.float32)
    shown = np.zeros(voxels.capacity, bool)
    shown[seen] = True
    after = observed(voxels, select(jnp.asarray(shown)), place, CAMERA.focal)
    for found, state in ((low, voxels), (high, after)):
        truth = np.asarray(score_voxels(state, place, CAMERA.focal).value)[seen]
        np.testing.assert_allclose(found[part][is_voxel], truth, atol=2e-4)
    gain = high[part][is_voxel] - low[part][is_voxel]
    # The first place is where the map was seen from: 1 - R is left there, and no look mends it.
    assert gain.max() == 0.0 if k == 0 else gain.max() > 0.01
    assert (1.0 - low[part][is_voxel]).max() > 0.05


@pytest.mark.parametrize("is_gain", [False, True])
def test_frames_of_one_flight_add_no_more_than_each_by_itself(is_gain: bool):
    found = sights(is_gain=is_gain)
    alone, *_ = fly(found, star(), 0.4)
    joint, *_ = fly(found, chain(), 0.4)
    assert (np.diff(joint) >= 0.0).all()
    assert (joint >= alone - 1e-3).all()
    assert (joint <= np.cumsum(alone) + 1e-3).all()
    # All look at one hall: a sum would count the same surfaces again and again.
    assert joint[-1] < 0.9 * alone.sum()


def test_ways_that_part_do_not_see_each_others_frames():
    found = sights(is_gain=True)
    order, depth = np.array([0, 1, 2, 3]), np.array([0, 1, 0, 1])
    lengths = np.array([0.4, 0.8, 0.4, 0.8])
    both, *_ = fly(found, Tree(order, depth, np.full(4, 0.4), lengths), 0.4)
    second, *_ = fly(found, Tree(order[2:], depth[2:], np.full(2, 0.4), lengths[2:]), 0.4)
    np.testing.assert_array_equal(both[2:], second)


def test_a_way_has_as_many_frames_however_many_places_it_passes():
    found = sights(is_gain=True)
    steps = np.full(4, 0.1)
    passed = Tree(np.array([0, 1, 2, 3]), np.arange(4), steps, np.cumsum(steps))
    gains, *_ = fly(found, passed, 0.4)
    last, *_ = fly(found, star(), 0.4)
    np.testing.assert_allclose(gains[-1], last[-1], rtol=1e-6)


def test_decisions_fly_through_known_free_space_and_come_out_the_same():
    state, grid = known()
    grid = mark_free_ball(grid, jnp.asarray(EYE, jnp.float32), 0.6)
    policy = OursPath(PathConfig(num_candidates=20, num_spread=10, num_frontier=5, scoring=SCORING))
    first = policy.init(CAMERA, grid, key=jax.random.key(0))
    pose = np.eye(4)
    pose[:3, :3] = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
    pose[:3, 3] = EYE
    decisions = [policy.decide(first, state, grid, pose, key=jax.random.key(1))[0] for _ in "ab"]
    assert decisions[0] is not None
    assert decisions[1] is not None
    np.testing.assert_array_equal(decisions[0].T_world_camera, decisions[1].T_world_camera)
    free = np.asarray(grid.free)
    way = (decisions[0].waypoints - np.asarray(grid.origin)) / float(grid.cell_size)
    assert all(segment_is_inside(free, a, b) for a, b in itertools.pairwise(way))
    assert decisions[0].score == decisions[0].utilities["rate"].max()


def test_settings_that_cannot_work_are_refused():
    refused: list[dict[str, Any]] = [
        {"sample": 0}, {"look_every": 0.0}, {"spare_seconds": float("nan")}
    ]  # fmt: skip
    for wrong in refused:
        with pytest.raises(ValueError, match=next(iter(wrong))):
            PathConfig(**wrong)
    policy = make_policy("r3jax.planning.policies.flight:OursPath")
    assert isinstance(policy, OursPath)
