"""Scores and decisions on four devices: run by `test_sharding.py` in a process that has as many.

How many there are is settled when JAX starts; a flag makes four devices of one CPU. All tests
score ten candidates in one map with one camera, so that little is compiled.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import r3jax
from r3jax.geometry.cameras import Camera
from r3jax.planning.candidates import poses_along
from r3jax.planning.registry import make_policy
from r3jax.scoring import batch
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.gather import gather_in_range
from tests.planning.rooms import CELL, ORIGIN, center, grid_of, pose_at, two_rooms

NUM = 10
CAMERA = Camera.from_fov(32, 32, 90.0)
CONFIG = ScoringConfig(max_range=4.0, zbuffer_size=32)


@functools.cache
def flat():
    """Two rooms, the second half known, with voxels on the walls that are known."""
    free, walls = two_rooms()
    known = (np.arange(25) < 18)[:, None, None]
    points = (np.argwhere(walls & known) + 0.5) * CELL + ORIGIN
    points = points[np.random.default_rng(1).random(len(points)) < 0.8]
    state = r3jax.integrate_points(
        r3jax.empty_map(1 << 13, 0.1),
        points.astype(np.float32),
        np.full(points.shape, 0.5, np.float32),
        center(6, 6, 4).astype(np.float32),
    )
    return state, grid_of(free & known, walls & known)


@pytest.fixture
def one_device(monkeypatch):
    """Called: from here on this process has one device only."""
    first = jax.local_devices()[:1]
    return lambda: monkeypatch.setattr(jax, "local_devices", lambda: first)


def poses():
    """Here and there in the first room."""
    random = np.random.default_rng(0)
    places = [center(*random.uniform((2, 2, 2), (10, 11, 7))) for _ in range(NUM)]
    return poses_along(np.array(places), random.standard_normal((NUM, 3))).astype(np.float32)


@pytest.mark.parametrize(
    ("scorer", "candidates"),
    [(batch.score_views, poses()), (batch.score_positions, poses()[:, :3, 3])],
    ids=["views", "positions"],
)
def test_scores_are_those_of_one_device_bit_for_bit(scorer, candidates, one_device):
    several = scorer(*flat(), CAMERA, candidates, CONFIG)
    one_device()
    one = scorer(*flat(), CAMERA, candidates, CONFIG)
    assert jax.tree.structure(several) == jax.tree.structure(one)
    for a, b in zip(jax.tree.leaves(several), jax.tree.leaves(one), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
        assert len(a) == NUM
        assert len(np.unique(a)) > 2
        assert len(a.devices()) == 1  # fit to be used beside the map


def test_each_device_holds_a_share_and_the_whole_map(monkeypatch):
    given = []
    kept = batch._score
    monkeypatch.setattr(batch, "_score", lambda *a: given.append(a) or kept(*a))
    candidates, devices = jnp.asarray(poses()), jax.local_devices()
    voxels, cells, _ = gather_in_range(*flat(), candidates[:, :3, 3], CONFIG)
    known = (voxels, cells, CAMERA, CONFIG)
    scores = batch.score_on_devices(batch._score_views, known, candidates, devices)
    ((_, _, spread, shares),) = given
    for shared in (shares, *jax.tree.leaves(scores)):
        shards = sorted(shared.addressable_shards, key=lambda shard: shard.index[0].start)
        assert [shard.device for shard in shards] == devices
        assert [shard.data.shape[0] for shard in shards] == [3] * 4
    for whole in jax.tree.leaves(spread):
        assert whole.sharding.is_fully_replicated
        assert len(whole.addressable_shards) == 4


def size_of_share(scale, candidates):
    """A score that says among how many candidates it was computed."""
    return scale * candidates[:, 0], jnp.full(candidates.shape[0], candidates.shape[0])


def test_each_device_scores_its_share_only() -> None:
    for count in (3, 4, 5, 11):
        candidates = jnp.arange(count, dtype=jnp.float32)[:, None]
        score = functools.partial(size_of_share, jnp.float32(2.0))
        values, shares = batch.map_over_devices(score, candidates)
        np.testing.assert_array_equal(values, 2.0 * np.arange(count))
        np.testing.assert_array_equal(shares, np.full(count, -(-count // min(4, count))))


def test_scores_compile_once_for_all_maps_and_settings():
    traces = []

    def score(scale, others, candidates):
        traces.append(others)
        return scale * candidates[:, 0]

    for scale in (1.0, 2.0, 3.0):
        candidates = jnp.full((6, 1), scale)
        values = batch.map_over_devices(
            functools.partial(score, scale, {"name": center}), candidates
        )
        np.testing.assert_array_equal(values, np.full(6, scale * scale))
    assert traces == [{"name": center}]


@pytest.mark.parametrize("name", ["r3", "r3-pano", "active-gs"])
def test_a_decision_is_that_of_one_device(name, one_device, monkeypatch):
    used = []
    kept = batch.score_on_devices
    monkeypatch.setattr(batch, "score_on_devices", lambda *a: used.append(a[3]) or kept(*a))
    policy = make_policy(name, num_candidates=NUM, num_frontier=3, scoring=CONFIG)
    state, grid = flat()

    def decide():
        planner = policy.init(CAMERA, grid, key=jax.random.key(0))
        start = pose_at(center(6, 6, 4))
        return policy.decide(planner, state, grid, start, key=jax.random.key(1))[0]

    several = decide()
    assert used == [jax.local_devices()]
    one_device()
    one = decide()
    assert len(used) == 1
    np.testing.assert_array_equal(several.T_world_camera, one.T_world_camera)
    np.testing.assert_array_equal(several.candidates, one.candidates)
    assert several.utilities.keys() == one.utilities.keys()
    for key, values in several.utilities.items():
        np.testing.assert_array_equal(values, one.utilities[key])
    assert len(np.unique(several.utilities["utility"])) > 5
