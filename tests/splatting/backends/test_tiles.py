"""Tile lists against a plain NumPy count, and the budget that is never exceeded in silence."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.splatting.backends import xla

COUNT, WIDTH, HEIGHT, BUDGET = 60, 50, 38, 400
COLUMNS, ROWS = 4, 3


def boxes(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centers, half sizes and depths; some not drawn, some far larger than the image."""
    rng = np.random.default_rng(seed)
    center = rng.uniform(-5, 55, (2, COUNT))
    reach = rng.exponential(6.0, (2, COUNT))
    reach[:, :3] = [[30.0, 1e9, 3e38], [2.0, 1e9, 3e38]]
    low, high = center - reach, center + reach
    size = np.array([[WIDTH], [HEIGHT]])
    outside = ~((high > 0) & (low < size)).all(axis=0)
    reach[:, outside | (rng.uniform(size=COUNT) < 0.2)] = -1.0
    depth = rng.choice([0.5, 1.0, 1.0000001, 3.0, 80.0, 2e5], COUNT) + rng.choice([0, 0.3], COUNT)
    return center.astype(np.float32), reach.astype(np.float32), depth.astype(np.float32)


def expected_lists(center, reach, depth) -> list[list[int]]:
    """For each tile its Gaussians from near to far; the first row first at equal depths."""
    drawn = [i for i in np.argsort(depth, kind="stable") if reach[0, i] >= 0]
    lists = []
    for row, column in np.ndindex(ROWS, COLUMNS):
        corner = np.array([column, row]) * 16.0
        touches = lambda i, corner=corner: (
            np.all(center[:, i] - reach[:, i] < corner + 16.0)
            and np.all(center[:, i] + reach[:, i] >= corner)
        )
        lists.append([i for i in drawn if touches(i)])
    return lists


def compiled(budget: int = BUDGET):
    """`list_tiles`, for images of one size."""
    function = xla.list_tiles
    return jax.jit(lambda c, r, d: function(c, r, d, WIDTH, HEIGHT, budget))


list_tiles = compiled()


def assert_lists(seed: int = 0) -> None:
    """Every tile has exactly its Gaussians, in order."""
    arrays = boxes(seed)
    expected = expected_lists(*arrays)
    found = list_tiles(*arrays)
    np.testing.assert_array_equal(found.count, [len(tile) for tile in expected])
    for start, count, tile in zip(found.start, found.count, expected, strict=True):
        np.testing.assert_array_equal(found.ids[int(start) : int(start) + int(count)], tile)
    assert int(found.num_intersections) == sum(map(len, expected))
    assert int(found.overflow) == 0


def test_overflow_is_exact() -> None:
    """What found no room is counted; what did lies in the lists, which stay in their bounds."""
    arrays = boxes(0)
    needed = sum(map(len, expected_lists(*arrays)))
    for budget in (needed, needed - 1, 7):
        found = compiled(budget)(*arrays)
        assert int(found.num_intersections) == needed
        assert int(found.overflow) == needed - budget
        assert int(found.count.sum()) == budget == found.ids.shape[0]
        assert int((found.start + found.count).max()) <= budget


@given(st.integers(0, 10_000))
def test_lists_equal_a_plain_count(seed):
    assert_lists(seed)


@pytest.mark.parametrize("share", [1.0, 0.4, 0.1, 0.0])
def test_every_size_of_the_sort_gives_the_same(share):
    """A large budget is sorted in full only where it is needed."""
    rng = np.random.default_rng(1)
    count, budget = 40_000, 1 << 17
    center = jnp.asarray(rng.uniform(0, 64, (2, count)), dtype=jnp.float32)
    reach = np.full((2, count), 4.0, dtype=np.float32)
    reach[:, rng.uniform(size=count) >= share] = -1.0
    depth = jnp.asarray(rng.uniform(0.02, 50.0, count), dtype=jnp.float32)
    found = _list_many(center, reach, depth, budget)
    low, high = np.clip((center - reach) // 16, 0, 3), np.clip((center + reach) // 16, 0, 3)
    needed = int(np.where(reach[0] >= 0, (high - low + 1).prod(axis=0), 0).sum())
    assert int(found.num_intersections) == needed == int(found.count.sum())
    for start, tile_count in zip(found.start, found.count, strict=True):
        along = np.asarray(depth)[np.asarray(found.ids)[int(start) : int(start + tile_count)]]
        assert np.all(np.diff(along) >= 0)


_list_many = jax.jit(
    lambda c, r, d, budget: xla.list_tiles(c, r, d, 64, 64, budget), static_argnums=3
)


def test_counts_saturate_where_they_would_wrap_around():
    """70 000 Gaussians that each cover 36 864 tiles: more pairs than an int32 holds."""
    count, edge = 70_000, 192 * 16
    big = jnp.full((2, count), 1e6)
    lists = jax.jit(lambda r: xla.list_tiles(r * 0.0, r, r[0], edge, edge, 1000))(big)
    assert int(lists.num_intersections) == 2**31 - 1
    assert int(lists.overflow) == 2**31 - 1 - 1000
    assert int(lists.count.sum()) == 1000


def test_pairs_that_do_not_fit_one_integer_are_sorted_all_the_same():
    """Bits for the tile and for the Gaussian: more than 32 together."""
    rng = np.random.default_rng(2)
    tile = jnp.asarray(rng.integers(0, 10, 200), dtype=jnp.int32)
    rank = jnp.asarray(rng.permutation(200), dtype=jnp.int32)
    sort = xla._sort_pairs
    narrow, wide = sort(tile, rank, 10, 200), sort(tile, rank, 10, 2**30)
    for one, other in zip(narrow, wide, strict=True):
        np.testing.assert_array_equal(one, other)
