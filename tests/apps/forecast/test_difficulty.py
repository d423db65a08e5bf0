"""The contrast of a voxel's surroundings: against a plain program in float64, and its laws."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import r3jax
from r3jax.apps.forecast import expected_error as difficulty
from r3jax.geometry.voxels import unpack
from tests.strategies import VOXEL_SIZE, Sighting, sightings

CAPACITY = 1 << 9
MOST = 64
"""Voxels of a map at most."""

AROUND = [step for step in itertools.product((-1, 0, 1), repeat=3) if any(step)]


def map_of_colors(colors: dict[tuple[int, int, int], np.ndarray]) -> r3jax.MapState:
    """A map of these voxels, each seen once from above."""
    points, rgb = np.zeros((MOST, 3), np.float32), np.zeros((MOST, 3), np.float32)
    # Padded to one length, so that all maps share one program.
    points[: len(colors)] = (np.array(list(colors)) + 0.5) * VOXEL_SIZE
    rgb[: len(colors)] = list(colors.values())
    state = r3jax.empty_map(CAPACITY, VOXEL_SIZE)
    above = np.array([0.0, 0.0, 9.0], np.float32)
    return r3jax.integrate_points(state, points, rgb, above, valid=np.arange(MOST) < len(colors))


def difficulties(state: r3jax.MapState, module=None) -> dict[tuple[int, int, int], float]:
    """The difficulty of every voxel by its index."""
    value = np.asarray((module or r3jax).voxel_difficulty(state))
    there = np.asarray(state.present)
    index = np.stack([np.asarray(x) for x in unpack(state.key[0], state.key[1])], axis=1)
    return {tuple(i.tolist()): float(v) for i, v in zip(index[there], value[there], strict=True)}


def expected_difficulty(colors: dict[tuple[int, int, int], np.ndarray], at) -> float:
    """The root of the mean squared difference to what there is around, in float64."""
    around = [tuple(np.add(at, step).tolist()) for step in AROUND]
    squares = [np.mean((colors[b] - colors[at]) ** 2) for b in around if b in colors]
    return float(np.sqrt(np.mean(squares))) if squares else 0.0


def random_colors(seed: int) -> dict[tuple[int, int, int], np.ndarray]:
    """A crowd of voxels with colors at random, some of them alone."""
    random = np.random.default_rng(seed)
    index = {tuple(i) for i in random.integers(-2, 2, (40, 3)).tolist()}
    index |= {(40, 0, 0), (-50, 7, 7), (-51, 8, 7)}
    return {i: random.random(3).astype(np.float32).astype(np.float64) for i in sorted(index)}


def test_the_difficulty_is_the_contrast_to_what_touches_a_voxel() -> None:
    for seed in range(3):
        colors = random_colors(seed)
        found = difficulties(map_of_colors(colors), difficulty)
        assert found.keys() == colors.keys()
        for at, value in found.items():
            assert value == pytest.approx(expected_difficulty(colors, at), abs=1e-5), at


def joined(state: r3jax.MapState, found: list[Sighting]) -> r3jax.MapState:
    for one in found:
        state = r3jax.integrate_points(state, one.points, one.rgb, one.position, one.focal)
    return state


def assert_same(one: dict, other: dict) -> None:
    assert one.keys() == other.keys()
    np.testing.assert_allclose(list(one.values()), [other[at] for at in one], atol=2e-4)


@settings(max_examples=10)
@given(st.lists(sightings(), min_size=2, max_size=4), st.randoms(use_true_random=False))
def test_neither_order_nor_merging_changes_a_difficulty(found, random):
    empty = r3jax.empty_map(CAPACITY, VOXEL_SIZE)
    whole = difficulties(joined(empty, found))
    shuffled = random.sample(found, len(found))
    assert_same(whole, difficulties(joined(empty, shuffled)))
    parts = joined(empty, found[:1]), joined(empty, found[1:])
    assert_same(whole, difficulties(r3jax.merge(*parts)))
    assert_same(whole, difficulties(r3jax.grow(joined(empty, found), 2 * CAPACITY)))


@settings(max_examples=10)
@given(st.integers(0, 1000), st.tuples(*[st.integers(-500, 500)] * 3))
def test_a_world_moved_by_whole_voxels_is_as_hard(seed, shift):
    colors = random_colors(seed)
    moved = {tuple(np.add(at, shift).tolist()): color for at, color in colors.items()}
    here, there = difficulties(map_of_colors(colors)), difficulties(map_of_colors(moved))
    for at, value in here.items():
        assert there[tuple(np.add(at, shift).tolist())] == value


def test_a_plain_wall_is_not_hard_and_rows_without_a_voxel_have_none():
    wall = {(x, 0, z): np.full(3, 0.6) for x in range(6) for z in range(6)}
    state = map_of_colors(wall)
    assert np.abs(np.asarray(r3jax.voxel_difficulty(state))).max() < 1e-6
    checked = {at: np.full(3, 0.5 + 0.4 * (-1) ** sum(at)) for at in wall}
    hard = np.asarray(r3jax.voxel_difficulty(map_of_colors(checked)))
    there = np.asarray(map_of_colors(checked).present)
    assert hard[there].min() > 0.3
    assert (hard[~there] == 0.0).all()


def test_a_difficulty_has_a_gradient_even_where_it_is_0():
    state = map_of_colors({(x, 0, 0): np.full(3, 0.5) for x in range(4)})
    total = lambda m: jnp.sum(r3jax.voxel_difficulty(m))
    gradient = jax.grad(total, allow_int=True)(state)
    assert np.isfinite(np.asarray(gradient.mean)).all()
