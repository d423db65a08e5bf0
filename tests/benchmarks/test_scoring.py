"""How long the closed forms take on 60 000 voxels. Run by `make benchmark`."""

import jax
import numpy as np
import pytest

import r3jax
from r3jax.planning.registry import make_policy
from r3jax.scoring.batch import score_positions, score_views

pytestmark = pytest.mark.full


def test_voxel_renderability_and_panorama(benchmark, explored, scoring):
    """Target: 8 ms together."""
    position, focal = explored.pose[:3, 3], explored.camera.focal

    def query():
        return jax.block_until_ready(
            (
                r3jax.voxel_renderability(explored.map, position, focal),
                r3jax.panorama(explored.map, explored.grid, explored.camera, position, scoring),
            )
        )

    query()
    terms, panorama = benchmark(query)
    assert float(terms.value.max()) > 0.9
    assert float(panorama.best_score) > 0.0


def test_view_utility(benchmark, explored, scoring):
    """Target: 2 ms."""
    query = lambda: jax.block_until_ready(
        r3jax.view_utility(explored.map, explored.grid, explored.camera, explored.pose, scoring)
    )
    query()
    assert float(benchmark(query).rendering) > 0.0


def test_renderability(benchmark, explored):
    query = lambda: jax.block_until_ready(
        r3jax.renderability(explored.map, explored.camera, explored.pose)
    )
    query()
    assert float(benchmark(query)) > 0.5


def test_100_views(benchmark, explored, scoring):
    poses = np.repeat(np.asarray(explored.pose)[None], 100, axis=0)
    score = lambda: score_views(explored.map, explored.grid, explored.camera, poses, scoring)
    score()
    assert benchmark(score).total.shape == (100,)


def test_100_panoramas(benchmark, explored, scoring):
    positions = np.repeat(np.asarray(explored.pose)[None, :3, 3], 100, axis=0)
    score = lambda: score_positions(
        explored.map, explored.grid, explored.camera, positions, scoring
    )
    score()
    assert benchmark(score).best_score.shape == (100,)


def test_planning_step(benchmark, explored):
    """Target: 400 ms for a whole decision of `ours-pano` among 100 candidates."""
    policy = make_policy("ours-pano")
    state = policy.init(explored.camera, explored.grid, key=jax.random.key(0))
    for frame in explored.frames:
        state = policy.observe(state, explored.map, frame)
    pose, key = np.asarray(explored.pose, dtype=np.float64), jax.random.key(1)
    decide = lambda: policy.decide(state, explored.map, explored.grid, pose, key=key)
    decide()
    decision, _, info = benchmark(decide)
    assert decision is not None
    assert info.num_candidates == 100
