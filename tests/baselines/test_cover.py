"""COVER's term by hand and in float64, its laws, and what the policy makes of a wall."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.baselines import cover
from r3jax.baselines.cover import Cover
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.mapping.state import empty_map
from r3jax.planning.candidates import candidates_along
from r3jax.planning.decide import net_utility
from tests.planning import walls

pytestmark = pytest.mark.full

LATTICE = fibonacci_lattice(64)
NUM = 6  # pixels, in one row


def words_of(bins: list[list[int]]) -> jnp.ndarray:
    """Bit masks of the bins that each pixel's voxel was seen from, [2, 1, NUM]."""
    words = np.zeros((2, 1, NUM), np.uint32)
    for pixel, seen in enumerate(bins):
        for k in seen:
            words[k // 32, 0, pixel] |= np.uint32(1 << (k % 32))
    return jnp.asarray(words)


def coverage(module, bins: list[list[int]], offset: np.ndarray, hit: list[int]) -> float:
    seen = module.SeenBins(words_of(bins), 64)
    offset = jnp.asarray(offset.T[:, None, :], jnp.float32)
    return float(module.coverage_of_pixels(seen, offset, jnp.asarray([hit], jnp.float32)))


def test_the_term_by_hand() -> None:
    """One covered pixel at a time, then some together."""
    q, module = LATTICE, cover
    between = (q[3] + q[40]) / np.linalg.norm(q[3] + q[40])
    cases = [
        ([5], q[5], 1.0),  # seen from there
        ([5], -q[5], 0.0),  # from the opposite side only
        ([45], 7.0 * q[45], 1.0),  # a bin of the second word, from far away
        ([], q[5], 0.0),  # never seen
        ([3], 5.0 * q[60], (1.0 + q[3] @ q[60]) / 2.0),
        ([3, 40, 60], between, (1.0 + max(q[[3, 40, 60]] @ between)) / 2.0),  # the nearest counts
    ]
    bins, offset, value = (list(part) for part in zip(*cases, strict=True))
    for pixel in range(NUM):
        hit = np.eye(NUM, dtype=int)[pixel].tolist()
        found = coverage(module, bins, np.array(offset), hit)
        np.testing.assert_allclose(found, value[pixel], atol=1e-6)
    found = coverage(module, bins, np.array(offset), [1, 1, 0, 1, 0, 1])
    np.testing.assert_allclose(found, (1.0 + 0.0 + 0.0 + value[5]) / 4.0, atol=1e-6)
    assert coverage(module, bins, np.array(offset), [0] * NUM) == 1.0


_IS_VISITED = """(visited[k // 32] & jnp.uint32(1 << (k % 32))) != jnp.uint32(0)
        cosine = q_x"""
_NEAREST = "jnp.maximum(best, jnp.where(is_visited, cosine, -1.0))"


BINS = st.lists(st.lists(st.integers(0, 63), max_size=5), min_size=NUM, max_size=NUM)
HITS = st.lists(st.integers(0, 1), min_size=NUM, max_size=NUM)


@given(BINS, HITS, st.integers(0, 10_000), st.integers(0, 63))
def test_the_term_in_float64_and_its_laws(bins, hit, seed, extra):
    """Between 0 and 1; one more direction never lowers it; order of pixels and scale are free."""
    offset = np.random.default_rng(seed).normal(size=(NUM, 3))
    found = coverage(cover, bins, offset, hit)
    unit = offset / np.linalg.norm(offset, axis=1, keepdims=True)
    values = [
        (1.0 + max((LATTICE[k] @ r for k in seen), default=-1.0)) / 2.0
        for seen, r, is_hit in zip(bins, unit, hit, strict=True)
        if is_hit
    ]
    np.testing.assert_allclose(found, np.mean(values) if values else 1.0, atol=1e-6)
    assert 0.0 <= found <= 1.0
    assert coverage(cover, [[*seen, extra] for seen in bins], offset, hit) >= found
    turned = coverage(cover, bins[::-1], 3.0 * offset[::-1], hit[::-1])
    np.testing.assert_allclose(turned, found, atol=1e-6)


@pytest.fixture(scope="module")
def scored():
    """The wall, and a box of which the far side in y is unexplored."""
    where = walls.situation(walls.wall(), walls.box(unexplored_from_y=1.0))
    looks = {
        "again": (walls.SEEN_FROM, (1.0, 0.0, 0.0)),
        "aslant": ((1.2, -1.1, 1.25), (0.6, 0.8, 0.0)),
        "close, from the side": ((1.8, 0.9, 1.25), (0.2, -1.0, 0.0)),
        "free space only": (walls.SEEN_FROM, (-1.0, -0.7, 0.0)),
        "the unknown": (walls.SEEN_FROM, (-0.4, 1.0, 0.0)),
    }
    places, axes = (np.array(part) for part in zip(*looks.values(), strict=True))
    candidates = candidates_along(places, axes)
    policy = Cover(walls.config(len(places)))
    _, utilities = policy.score(where, candidates, key=jax.random.key(0))
    return where, candidates.T_world_camera, policy, utilities, list(looks)


def test_new_directions_are_worth_more_than_old_ones(scored):
    _, _, _, utilities, names = scored
    value = dict(zip(names, utilities["rendering"], strict=True))
    # Bins are 25 degrees wide: (1 - cos 13 degrees) / 2 at the most.
    assert 0.0 <= value["again"] < 0.015
    assert value["again"] + 0.05 < value["aslant"] < value["close, from the side"] <= 1.0
    assert value["free space only"] == value["the unknown"] == 0.0


def test_unexplored_cells_count_as_in_active_gs(scored):
    where, poses, policy, utilities, names = scored
    expected = 1000.0 * walls.cells_in_view(where, poses) / where.grid.log_odds.size
    np.testing.assert_allclose(utilities["exploration"], expected)
    assert expected[names.index("the unknown")] > 1.0
    assert expected[names.index("free space only")] == 0.0
    both = utilities["exploration"] + utilities["rendering"]
    np.testing.assert_array_equal(utilities["utility"], both)
    path = {"path": np.arange(5.0)}
    weighed = net_utility(both, path["path"], policy.config.lambda2)
    np.testing.assert_array_equal(policy.weigh(utilities | path), weighed)


def test_a_map_that_holds_nothing_is_explored():
    """No pixel is covered: the unexplored cells alone decide."""
    where = walls.situation(empty_map(1 << 10, walls.VOXEL), walls.box(1.0))
    candidates = candidates_along(np.tile(walls.SEEN_FROM, (5, 1)), np.eye(3)[[0, 1, 0, 0, 1]])
    _, utilities = Cover(walls.config(5)).score(where, candidates, key=jax.random.key(0))
    assert not utilities["rendering"].any()
    np.testing.assert_array_equal(utilities["utility"], utilities["exploration"])
    assert utilities["utility"].argmax() in (1, 4)
