"""Several views at once: against scoring everything again on the whole map after every view."""

import functools
from unittest import mock

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import r3jax
from r3jax.errors import InputError
from r3jax.geometry.cameras import look_at
from r3jax.planning import next_views as real
from r3jax.scoring.batch import score_positions, score_views, score_views_near
from r3jax.scoring.simulated import simulate_view
from r3jax.scoring.utility import view_utility
from tests.planning.known_hall import (
    CAMERA,
    CONFIG,
    SCORING,
    after_view,
    for_scoring,
    known,
    safe_mask,
)

NUM = 24


def poses_of(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    eyes = rng.uniform([0.5, 0.5, 0.6], [2.5, 2.2, 1.8], (NUM, 3))
    return np.float64([look_at(eye, eye + rng.normal(size=3) * [1.0, 1.0, 0.5]) for eye in eyes])


def by_brute_force(poses: np.ndarray, k: int) -> tuple[list[int], list[float]]:
    """All left are scored again after every view, one by one, with every row of the map."""
    world = for_scoring()
    T = jnp.asarray(poses, jnp.float32)
    left, chosen, worth = set(range(len(poses))), [], []
    for _ in range(k):
        utility = {i: float(view_utility(*world, CAMERA, T[i], SCORING).total) for i in left}
        best = max(utility, key=lambda i: utility[i])
        chosen.append(best)
        worth.append(utility[best])
        left.remove(best)
        world = after_view(world, T[best])
    return chosen, worth


@pytest.mark.full
@given(st.integers(0, 300))
@settings(max_examples=5)
def test_lazy_choice_is_that_of_scoring_all_again(seed):
    state, grid = known()
    poses = poses_of(seed)
    views = real.next_views(state, grid, CAMERA, 5, poses=poses, config=CONFIG)
    chosen, worth = by_brute_force(poses, 5)
    np.testing.assert_allclose(views.utility, worth, rtol=2e-5)
    np.testing.assert_array_equal(views.T_world_camera, poses[chosen])
    assert (np.diff(views.utility) <= 1e-3).all()
    assert worth[-1] < 0.9 * worth[0]  # or nothing was conditioned on anything


def test_no_pose_is_taken_twice():
    state, grid = known()
    poses = poses_of(1)
    views = real.next_views(state, grid, CAMERA, NUM, poses=poses, config=CONFIG)
    order = [np.flatnonzero((poses == T).all(axis=(1, 2)))[0] for T in views.T_world_camera]
    assert sorted(order) == list(range(NUM))


@pytest.mark.full
def test_only_what_may_win_is_scored_again() -> None:
    """Hopeless poses are scored once."""
    module, scored = real, []

    def count(voxels, cells, camera, poses, config):
        scored.append(len(poses))
        return score_views_near(voxels, cells, camera, poses, config)

    with mock.patch.object(module, "score_views_near", count):
        module.next_views(*known(), CAMERA, 3, poses=poses_of(2), config=CONFIG)
    assert scored[0] == NUM
    assert sum(scored[1:]) < 2 * NUM


@given(st.integers(0, 300))
@settings(max_examples=10)
def test_a_view_never_adds_more_after_other_views(seed):
    """Diminishing returns, and so a path's value never falls by a view."""
    state, grid = for_scoring()
    first, second, view = jnp.asarray(poses_of(seed)[:3], jnp.float32)
    utility = lambda s: float(view_utility(s, grid, CAMERA, view, SCORING).rendering)
    one, _ = simulate_view(state, CAMERA, first, SCORING)
    both, _ = simulate_view(one, CAMERA, second, SCORING)
    assert utility(state) + 1e-3 >= utility(one)
    assert utility(one) + 1e-3 >= utility(both) >= 0.0


def test_a_batch_of_one_is_the_next_best_view():
    state, grid = for_scoring()
    poses = poses_of(3)
    scores = np.asarray(score_views(state, grid, CAMERA, poses, SCORING).total)
    views = r3jax.next_views(*known(), CAMERA, 1, poses=poses, config=CONFIG)
    np.testing.assert_array_equal(views.T_world_camera[0], poses[scores.argmax()])
    assert views.utility[0] == scores.max()


@pytest.mark.full
def test_without_poses_free_space_is_searched_in_all_directions():
    state, grid = for_scoring()
    safe = safe_mask()
    views = r3jax.next_views(*known(), CAMERA, 4, config=CONFIG)
    assert views.T_world_camera.shape == (4, 4, 4)
    origin = np.asarray(grid.origin, np.float64)
    cells = np.floor((views.T_world_camera[:, :3, 3] - origin) / 0.2).astype(int)
    assert safe[tuple(cells.T)].all()
    assert (np.diff(views.utility) <= 1e-3).all()
    again = r3jax.next_views(*known(), CAMERA, 4, config=CONFIG)
    np.testing.assert_array_equal(views.T_world_camera, again.T_world_camera)
    # The first is the best of the panoramas of the same places.
    centers = origin + (np.argwhere(safe) + 0.5) * float(grid.cell_size)
    places = centers[real.spread(centers, CONFIG.num_candidates)]
    panoramas = score_positions(state, grid, CAMERA, places, SCORING)
    assert views.utility[0] == pytest.approx(float(panoramas.best_score.max()), rel=1e-5)


def test_what_cannot_be_chosen_from_is_refused():
    state, grid = known()
    poses = poses_of(0)
    ask = functools.partial(r3jax.next_views, state, grid, CAMERA, config=CONFIG)
    with pytest.raises(ValueError, match=r"k .*1"):
        ask(0, poses=poses)
    with pytest.raises(ValueError, match=r"25.*24"):
        ask(25, poses=poses)
    with pytest.raises(ValueError, match=r"shape \[C, 4, 4\]"):
        ask(1, poses=poses[0])
    poses[2, 0, 0] = np.nan
    with pytest.raises(ValueError, match="pose 2"):
        ask(1, poses=poses)
    unknown = eqx.tree_at(lambda g: g.log_odds, grid, jnp.zeros_like(grid.log_odds))
    with pytest.raises(InputError):
        r3jax.next_views(state, unknown, CAMERA, 1, config=CONFIG)
