"""The Fibonacci lattice by its formula, and the nearest bin by brute force in float64."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.errors import InputError
from r3jax.geometry.sphere import (
    fibonacci_lattice,
    nearest_bin,
    octahedral_cell,
    octahedral_direction,
)

TIE = 2e-6
"""Cosines closer than this cannot be told apart in float32."""


def special_directions() -> np.ndarray:
    """Axes, edges and corners of the cube, both signs, and the poles' neighborhood."""
    grid = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 3)
    tilted = np.array([[s * 1e-4, t * 1e-4, z] for s in (-1, 1) for t in (-1, 1) for z in (-1, 1)])
    directions = np.concatenate([grid[np.abs(grid).sum(axis=1) > 0], tilted]).astype(np.float64)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def random_directions(num: int, seed: int) -> np.ndarray:
    directions = np.random.default_rng(seed).normal(size=(num, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("num", [1, 2, 64, 526])
def test_lattice_has_unit_length_and_even_heights(num):
    lattice = fibonacci_lattice(num)
    assert lattice.shape == (num, 3)
    np.testing.assert_allclose(np.linalg.norm(lattice, axis=1), 1.0, rtol=1e-12)
    k = np.arange(num)
    np.testing.assert_allclose(lattice[:, 2], 1.0 - 2.0 * (k + 0.5) / num, rtol=1e-12)


def test_lattice_turns_by_the_golden_angle():
    lattice = fibonacci_lattice(64)
    azimuth = np.arctan2(lattice[:, 1], lattice[:, 0])
    turn = np.exp(1j * azimuth) / np.exp(2j * np.pi * np.arange(64) * 2.0 / (1.0 + np.sqrt(5.0)))
    np.testing.assert_allclose(turn, 1.0, atol=1e-10)


def test_lattice_matches_the_golden_bins(shared):
    with np.load(shared("golden", "renderability_terms.npz")) as golden:
        np.testing.assert_allclose(fibonacci_lattice(64), golden["bins"], atol=1e-6)


def test_lattice_is_nearly_even():
    lattice = fibonacci_lattice(526)
    cosine = lattice @ lattice.T - 3.0 * np.eye(526)
    nearest = np.degrees(np.arccos(cosine.max(axis=1)))
    even = np.degrees(np.sqrt(4.0 * np.pi / 526))  # side of a square of one bin's area
    assert nearest.min() > 0.7 * even
    assert nearest.max() < 1.2 * even


def test_lattice_cannot_be_changed_by_its_users():
    with pytest.raises(ValueError, match="read-only"):
        fibonacci_lattice(64)[0, 0] = 2.0


def test_empty_lattice_is_refused():
    with pytest.raises(InputError):
        fibonacci_lattice(0)


@pytest.mark.parametrize("num", [1, 2, 64, 526])
def test_nearest_bin_is_the_brute_force_one(num):
    lattice = fibonacci_lattice(num)
    directions = np.concatenate([random_directions(4000, seed=num), special_directions(), lattice])
    find = jax.jit(functools.partial(nearest_bin, num=num))
    found = np.asarray(find(jnp.asarray(directions.T, jnp.float32)))
    cosine = directions @ lattice.T
    lost = cosine.max(axis=1) - cosine[np.arange(len(directions)), found]
    assert lost.max() < TIE
    ranked = np.sort(np.pad(cosine, ((0, 0), (1, 0)), constant_values=-2.0), axis=1)
    is_clear = ranked[:, -1] - ranked[:, -2] > TIE
    assert is_clear.mean() > 0.99
    np.testing.assert_array_equal(found[is_clear], cosine.argmax(axis=1)[is_clear])


def test_lattice_directions_are_their_own_bins():
    found = nearest_bin(jnp.asarray(fibonacci_lattice(526).T, jnp.float32), 526)
    np.testing.assert_array_equal(found, np.arange(526))


def test_octahedral_cell_holds_its_own_middle():
    size = 16
    middle = (np.arange(size) + 0.5) / size * 2.0 - 1.0
    v, u = np.meshgrid(middle, middle, indexing="ij")
    directions = octahedral_direction(u, v).reshape(-1, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, rtol=1e-12)
    cell = octahedral_cell(jnp.asarray(3.0 * directions.T, jnp.float32), size)
    np.testing.assert_array_equal(cell, np.arange(size * size))
