"""The hash table against a Python dictionary, up to full and beyond."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from r3jax.geometry.voxels import EMPTY_WORD
from r3jax.mapping import table as real
from r3jax.mapping.table import hash_key

CAPACITY, NUM_KEYS = 32, 12  # one shape: one compile

find = jax.jit(real.find)
find_or_insert = jax.jit(real.find_or_insert)


def empty_table(capacity: int = CAPACITY) -> jax.Array:
    return jnp.full((2, capacity), EMPTY_WORD, dtype=jnp.uint32)


def as_keys(words: np.ndarray) -> jax.Array:
    return jnp.asarray(words, jnp.uint32)


@st.composite
def batches(draw) -> tuple[np.ndarray, np.ndarray]:
    """Distinct keys out of a few hundred, so that calls repeat them, and which are valid.

    High and low words repeat separately: a table that compares only one of them errs.
    """
    number = draw(hnp.arrays(np.uint32, NUM_KEYS, elements=st.integers(0, 80), unique=True))
    valid = draw(hnp.arrays(bool, NUM_KEYS))
    return np.stack([number % 9, number // 9]).astype(np.uint32), valid


def insert_all(table, batch_list, insert=find_or_insert):
    """Inserts batch after batch as a dictionary would; returns the table and the dictionary."""
    rows: dict[tuple[int, int], int] = {}
    for words, valid in batch_list:
        table, found = insert(table, as_keys(words), jnp.asarray(valid))
        found = np.asarray(found)
        assert (found[~valid] == table.shape[1]).all()
        dropped = []
        for key, row in zip(words.T[valid].tolist(), found[valid].tolist(), strict=True):
            if row < table.shape[1]:
                assert rows.setdefault(tuple(key), row) == row, "a key moved"
            else:
                dropped.append(tuple(key))
        assert not rows.keys() & set(dropped), "a key was lost"
        assert not dropped or len(rows) == table.shape[1], "a key was dropped with room left"
    return table, rows


def assert_holds(table, rows: dict[tuple[int, int], int]) -> None:
    """The table has the dictionary's keys at its rows, and nothing else."""
    assert len(set(rows.values())) == len(rows), "two keys share a row"
    expected = np.full(table.shape, EMPTY_WORD, dtype=np.uint32)
    for key, row in rows.items():
        expected[:, row] = key
    np.testing.assert_array_equal(table, expected)


@given(st.lists(batches(), min_size=1, max_size=5))
def test_table_is_a_dictionary(batch_list):
    table, rows = insert_all(empty_table(), batch_list)
    assert_holds(table, rows)
    every = np.stack(np.meshgrid(np.arange(9), np.arange(9))).reshape(2, -1)
    expected = [rows.get((int(low), int(high)), CAPACITY) for low, high in every.T]
    found = find(table, as_keys(every), jnp.ones(81, dtype=bool))
    np.testing.assert_array_equal(found, expected)


@given(batches())
def test_padding_changes_nothing(batch):
    words, valid = batch
    before, rows = find_or_insert(empty_table(), as_keys(words), jnp.asarray(valid))
    other = np.where(valid, words, words + 1000).astype(np.uint32)
    after, rows_other = find_or_insert(empty_table(), as_keys(other), jnp.asarray(valid))
    np.testing.assert_array_equal(before, after)
    np.testing.assert_array_equal(rows, rows_other)
    nothing, none = find_or_insert(before, as_keys(words + 2000), jnp.zeros(NUM_KEYS, dtype=bool))
    np.testing.assert_array_equal(nothing, before)
    assert (np.asarray(none) == CAPACITY).all()


def random_keys(num: int, seed: int) -> np.ndarray:
    numbers = np.random.default_rng(seed).choice(1 << 40, num, replace=False)
    return np.stack([numbers & 0xFFFFFFFF, numbers >> 32]).astype(np.uint32)


def test_many_keys_find_their_place_at_the_load_that_the_loop_allows():
    keys = random_keys(int(0.7 * 4096), seed=0)
    table, rows = find_or_insert(empty_table(4096), as_keys(keys), jnp.ones(keys.shape[1], bool))
    pairs = zip(map(tuple, keys.T.tolist()), np.asarray(rows).tolist(), strict=True)
    assert_holds(table, dict(pairs))
    absent = random_keys(500, seed=1)
    assert (np.asarray(find(table, as_keys(absent), jnp.ones(500, bool))) == 4096).all()


def test_voxels_of_a_plane_spread_over_the_table():
    x, y = (axis.reshape(-1).astype(np.uint32) for axis in np.meshgrid(range(256), range(256)))
    hashed = np.asarray(hash_key(jnp.asarray(x | (y << 21)), jnp.asarray(y >> 11)))
    per_slot = np.bincount(hashed % 4096, minlength=4096)
    assert 0.8 < per_slot.var() / per_slot.mean() < 1.2  # Poisson: 1


# Laws of fixed examples ---------------------------------------------------------------------------


def fixed_batches() -> list[tuple[np.ndarray, np.ndarray]]:
    random = np.random.default_rng(3)
    batch_list = []
    for _ in range(4):
        number = random.choice(60, NUM_KEYS, replace=False)
        batch_list.append((np.stack([number % 6, number // 6]), random.random(NUM_KEYS) < 0.7))
    return batch_list


def test_dictionary() -> None:
    insert = jax.jit(real.find_or_insert)
    assert_holds(*insert_all(empty_table(), fixed_batches(), insert))


def test_full_table_keeps_its_keys_and_reports_the_rest() -> None:
    insert = jax.jit(real.find_or_insert)
    number = np.arange(NUM_KEYS)
    keys = [np.stack([number + NUM_KEYS * i, number]) for i in range(4)]
    valid = np.ones(NUM_KEYS, dtype=bool)
    table, rows = insert_all(empty_table(), [(words, valid) for words in keys], insert)
    assert len(rows) == CAPACITY
    assert_holds(table, rows)
    again, found = insert(table, as_keys(keys[0]), jnp.asarray(valid))
    np.testing.assert_array_equal(again, table)
    expected = [rows.get(tuple(key), CAPACITY) for key in keys[0].T.tolist()]
    np.testing.assert_array_equal(found, expected)
