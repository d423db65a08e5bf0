"""Panoramas that are kept, after imagined views: the same as if all were looked at anew."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r3jax.planning.candidates import poses_along
from r3jax.scoring import batch, panorama
from r3jax.scoring.gather import gather_in_range
from r3jax.scoring.simulated import simulate_view_near
from tests.planning.known_hall import CAMERA, EYE, SCORING, for_scoring

pytestmark = pytest.mark.full

NUM = 6
LOW, HIGH = np.array([0.5, 0.5, 0.8]), np.array([2.4, 2.2, 1.6])


def places_of(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(LOW, HIGH, (NUM, 3)).astype(np.float32)


def views_of(seed: int, num: int) -> np.ndarray:
    """From where the hall was seen, and beside it, [num, 4, 4]."""
    rng = np.random.default_rng([seed, 3])
    return poses_along(EYE + rng.uniform(-0.4, 0.4, (num, 3)), rng.normal(size=(num, 3)))


@functools.cache
def start():
    state, grid = for_scoring()
    corners = jnp.asarray(np.stack([LOW, HIGH]), jnp.float32)
    voxels, cells, _ = gather_in_range(state, grid, corners, SCORING)
    return voxels, cells


def after_views(seed: int, num: int):
    known = start()
    for pose in views_of(seed, num):
        known = simulate_view_near(*known, CAMERA, jnp.asarray(pose, jnp.float32), SCORING)
    return known


@functools.cache
def kept_of(seed: int):
    allowed = np.random.default_rng([seed, 5]).random((NUM, SCORING.panorama_bins)) < 0.5
    places = jnp.asarray(places_of(seed))
    first, kept = batch.cache_positions_near(*start(), CAMERA, places, SCORING, allowed)
    before = batch.score_positions_near(*start(), CAMERA, places, SCORING, allowed)
    np.testing.assert_array_equal(first.bin_scores, before.bin_scores)
    return places, allowed, kept, float(before.direction_scores.max())


@functools.cache
def anew(seed: int, num: int):
    places, allowed, _, _ = kept_of(seed)
    return batch.score_positions_near(*after_views(seed, num), CAMERA, places, SCORING, allowed)


def check(again, seed: int, num: int) -> None:
    """Every direction's score, the best of the allowed ones, and its pose."""
    places, allowed, _, scale = kept_of(seed)
    for name in ("bin_scores", "direction_scores", "best_score"):
        expected = getattr(anew(seed, num), name)
        np.testing.assert_allclose(getattr(again, name), expected, atol=1e-5 * scale, err_msg=name)
    best = np.where(allowed, again.direction_scores, -np.inf).max(axis=1)
    np.testing.assert_allclose(again.best_score, best)
    np.testing.assert_array_equal(again.T_world_camera[:, :3, 3], places)
    assert (np.asarray(again.bin_scores) >= 0.0).all()


def law_again(seed: int = 0, num: int = 2) -> None:
    (places, allowed, kept, _) = kept_of(seed)

    @jax.jit
    def score(after, items):
        one = lambda at: panorama.panorama_from_cache(
            at[0], start(), after, CAMERA, at[1], SCORING, at[2]
        )
        return jax.vmap(one)(items)

    check(score(after_views(seed, num), (kept, places, jnp.asarray(allowed))), seed, num)


@settings(max_examples=15)
@given(st.integers(0, 1000), st.integers(0, 3))
def test_again_is_anew(seed, num):
    places, allowed, kept, _ = kept_of(seed)
    after = after_views(seed, num)
    again = batch.score_cached_near(kept, start(), after, CAMERA, places, SCORING, allowed)
    check(again, seed, num)


def test_views_change_something():
    """Or the law would hold for what forgets them."""
    voxels, cells = start()
    after, left = after_views(0, 2)
    assert int((after.count > voxels.count).sum()) > 20
    assert int(cells.unexplored.sum()) - int(left.unexplored.sum()) > 20


def test_some_of_the_positions():
    places = jnp.asarray(places_of(4))
    _, kept = batch.cache_positions_near(*start(), CAMERA, places, SCORING)
    some = kept.at(jnp.asarray([4, 0, 3]))
    for name in ("bin_scores", "voxels", "cells"):
        values = np.asarray(getattr(kept, name))
        np.testing.assert_array_equal(getattr(some, name), values[[4, 0, 3]])


def test_the_law_holds_without_a_fault():
    law_again()
