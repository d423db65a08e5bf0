"""Shortest ways against SciPy's Dijkstra on the graph spelled out, bit for bit."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from r3jax.kernels.robot.shortest_paths import shortest_paths


def random_space(seed, share, shape=(11, 9, 7)):
    rng = np.random.default_rng(seed)
    usable = rng.random(shape) < share
    start = tuple(int(rng.integers(n)) for n in shape)
    usable[start] = True
    return usable, start


def spelled_out(usable, start):
    """Costs by SciPy: an edge for every step whose whole block is usable."""
    numbers = np.arange(usable.size).reshape(usable.shape)
    heads, tails, lengths = [], [], []
    for cell in np.argwhere(usable):
        for step in itertools.product((-1, 0, 1), repeat=3):
            block = [cell + part for part in itertools.product(*({0, d} for d in step))]
            inside = all(np.all(c >= 0) and np.all(c < usable.shape) for c in block)
            if any(step) and inside and all(usable[tuple(c)] for c in block):
                tails.append(numbers[tuple(cell)])
                heads.append(numbers[tuple(cell + step)])
                lengths.append(np.linalg.norm(step))
    graph = csr_matrix((lengths, (tails, heads)), shape=(usable.size, usable.size))
    return dijkstra(graph, indices=int(numbers[start])).reshape(usable.shape)


@pytest.mark.full
def test_costs_are_scipys():
    for seed, share in ((0, 0.5), (1, 0.7), (2, 0.85), (3, 0.95), (4, 1.0)):
        usable, start = random_space(seed, share)
        np.testing.assert_array_equal(shortest_paths(usable, start)[0], spelled_out(usable, start))


@given(st.integers(0, 1000), st.floats(0.3, 1.0))
def test_every_way_leads_back_to_the_start(seed, share):
    usable, start = random_space(seed, share)
    cost, previous = shortest_paths(usable, start)
    reached = np.isfinite(cost)
    assert np.array_equal(previous >= 0, reached & (cost > 0.0))
    assert not np.any(reached & ~usable)
    cells = np.argwhere(previous >= 0)
    before = np.stack(np.unravel_index(previous[previous >= 0], usable.shape), axis=1)
    steps = np.linalg.norm(cells - before, axis=1)
    np.testing.assert_array_equal(cost[tuple(cells.T)], cost[tuple(before.T)] + steps)
    assert cost[start] == 0.0


def test_nothing_is_reached_from_nowhere():
    cost, previous = shortest_paths(np.ones((3, 4, 5), dtype=bool), None)
    assert np.all(np.isinf(cost))
    assert np.all(previous == -1)


def test_a_space_of_one_cell():
    cost, previous = shortest_paths(np.ones((1, 1, 1), dtype=bool), (0, 0, 0))
    assert cost.tolist() == [[[0.0]]]
    assert previous.tolist() == [[[-1]]]
