"""Joining statistics: Chan's rule against float64 over all observations, bins, maxima, drops."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.mapping import join as real
from r3jax.mapping.join import Statistics, grow, merge
from r3jax.mapping.seen import bin_words
from r3jax.mapping.state import MapState, empty_map
from tests.mapping.reference import Row, assert_same_rows, read_map

CAPACITY, NUM, VOXEL_SIZE = 16, 6, 0.0625  # one shape: one compile
BINS = (0, 1, 31, 32, 33, 63)  # few, so that batches share them; both words

join = jax.jit(real.join)


class Batch:
    """Observations of up to `NUM` voxels: what a frame or another map knows of them."""

    def __init__(self, seed: int, num_voxels: int = 10, padding: float = 0.3) -> None:
        random = np.random.default_rng(seed)
        number = random.choice(num_voxels, NUM, replace=False)
        self.voxels = [(int(n) - 4, 0, -int(n)) for n in number]
        self.valid = random.random(NUM) >= padding
        self.colors = [random.random((random.integers(1, 5), 3)) for _ in range(NUM)]
        self.bins = [set(random.choice(BINS, 3).tolist()) for _ in range(NUM)]
        self.resolution = random.uniform(1.0, 500.0, NUM)

    def statistics(self, kind=Statistics):
        """As the package takes them; padding holds values that would show."""
        packed = [sum((c + (1 << 20)) << 21 * i for i, c in enumerate(v)) for v in self.voxels]
        words = np.zeros((2, NUM), dtype=np.uint32)
        for column, bins in enumerate(self.bins):
            for b in bins:
                words[b // 32, column] |= np.uint32(1 << (b % 32))
        key = [[p & 0xFFFFFFFF for p in packed], [p >> 32 for p in packed]]
        return kind(
            key=jnp.asarray(key, jnp.uint32),
            valid=jnp.asarray(self.valid),
            count=jnp.array([len(c) for c in self.colors], jnp.float32),
            mean=jnp.array([c.mean(axis=0) for c in self.colors], jnp.float32).T,
            m2=jnp.array([((c - c.mean(axis=0)) ** 2).sum() for c in self.colors], jnp.float32),
            visited=jnp.asarray(words),
            resolution=jnp.asarray(self.resolution, jnp.float32),
        )


def expected_rows(batches: list[Batch]) -> dict:
    """All observations of each voxel at once, in float64."""
    voxels = {v for b in batches for v, is_valid in zip(b.voxels, b.valid, strict=True) if is_valid}
    rows = {}
    for voxel in voxels:
        seen = [
            (batch, i)
            for batch in batches
            for i in range(NUM)
            if batch.valid[i] and batch.voxels[i] == voxel
        ]
        colors = np.concatenate([batch.colors[i] for batch, i in seen])
        rows[voxel] = Row(
            bins=frozenset().union(*(batch.bins[i] for batch, i in seen)),
            count=len(colors),
            mean=colors.mean(axis=0),
            m2=float(((colors - colors.mean(axis=0)) ** 2).sum()),
            resolution=max(batch.resolution[i] for batch, i in seen),
        )
    return rows


def map_of(batches: list[Batch], join=join, kind=Statistics, capacity: int = CAPACITY) -> MapState:
    state = empty_map(capacity, VOXEL_SIZE)
    for batch in batches:
        state = join(state, batch.statistics(kind))
    return state


seeds = st.integers(0, 1 << 20)


@given(st.lists(seeds, min_size=1, max_size=5))
def test_joins_equal_the_statistics_of_all_observations(chosen):
    batches = [Batch(seed) for seed in chosen]
    state = map_of(batches)
    assert_same_rows(read_map(state), expected_rows(batches))
    assert int(state.dropped) == 0


@given(st.lists(seeds, min_size=2, max_size=5), st.randoms(use_true_random=False))
def test_order_of_joins_does_not_matter(chosen, random):
    batches = [Batch(seed) for seed in chosen]
    shuffled = random.sample(batches, len(batches))
    assert_same_rows(read_map(map_of(shuffled)), read_map(map_of(batches)))


@given(seeds, seeds)
def test_padding_changes_nothing(first, second):
    before = map_of([Batch(first)])
    after = join(before, Batch(second, padding=1.0).statistics())
    assert_identical(after, before)


def assert_identical(actual: MapState, expected: MapState) -> None:
    jax.tree.map(np.testing.assert_array_equal, actual, expected)


@given(st.lists(seeds, max_size=3), st.lists(seeds, max_size=3))
def test_merge_equals_joining_both_sequences(first, second):
    a, b = [Batch(seed) for seed in first], [Batch(seed) for seed in second]
    merged = read_map(merge(map_of(a), map_of(b)))
    assert_same_rows(merged, read_map(map_of(a + b)))
    assert_same_rows(read_map(merge(map_of(b), map_of(a))), merged)


@given(st.lists(seeds, max_size=3))
def test_merging_with_an_empty_map_changes_nothing(chosen):
    state = map_of([Batch(seed) for seed in chosen])
    assert_identical(merge(state, empty_map(CAPACITY, VOXEL_SIZE)), state)
    assert_same_rows(read_map(merge(empty_map(CAPACITY, VOXEL_SIZE), state)), read_map(state))


@given(st.lists(seeds, max_size=3))
def test_growing_keeps_everything(chosen):
    state = map_of([Batch(seed) for seed in chosen])
    larger = grow(state, 4 * CAPACITY)
    assert larger.capacity == 4 * CAPACITY
    assert float(larger.voxel_size) == VOXEL_SIZE
    rows, rows_larger = read_map(state), read_map(larger)
    assert rows.keys() == rows_larger.keys()
    for voxel, row in rows.items():
        np.testing.assert_equal(rows_larger[voxel]._asdict(), row._asdict())


@given(st.lists(seeds, min_size=1, max_size=4), seeds)
def test_bins_and_resolution_only_grow(chosen, last):
    before = map_of([Batch(seed) for seed in chosen])
    rows, later = read_map(before), read_map(join(before, Batch(last).statistics()))
    for voxel, row in rows.items():
        assert later[voxel].bins >= row.bins
        assert later[voxel].resolution >= row.resolution
        assert later[voxel].count >= row.count


def test_growing_in_time_drops_nothing():
    full = map_of([FULL[0]], capacity=8)
    larger = grow(full, 16)
    state = join(larger, FULL[1].statistics())
    assert int(state.dropped) == 0
    assert_same_rows(read_map(state), expected_rows(FULL[:2]))


@pytest.mark.parametrize("num_bins", [1, 31, 32, 33, 64, 100])
def test_bin_words_set_one_bit(num_bins):
    num_words = -(-num_bins // 32)
    words = np.asarray(bin_words(jnp.arange(num_bins, dtype=jnp.int32), num_words)).astype(object)
    numbers = sum(words[i] << 32 * i for i in range(num_words))
    assert list(numbers) == [1 << b for b in range(num_bins)]


def test_maps_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match=r"64.*32"):
        merge(empty_map(16), empty_map(16, num_bins=32))
    with pytest.raises(ValueError, match=r"0.05.*0.1"):
        merge(empty_map(16), empty_map(16, voxel_size=0.1))


def test_bad_capacities_are_refused():
    with pytest.raises(ValueError, match=r"16.*8"):
        grow(empty_map(16), 8)
    with pytest.raises(ValueError, match="24"):
        grow(empty_map(16), 24)


# Laws of fixed examples ---------------------------------------------------------------------------

FULL = [Batch(seed, num_voxels=20, padding=0.0) for seed in (0, 1, 2)]


def test_joins() -> None:
    batches = [Batch(seed, num_voxels=7) for seed in range(4)]
    state = map_of(batches, jax.jit(real.join), real.Statistics)
    assert_same_rows(read_map(state), expected_rows(batches))


def test_full_map_keeps_its_rows_and_counts_what_it_drops() -> None:
    """8 rows for 13 voxels: what is in stays in, each loss is counted once and for good."""
    join, dropped = jax.jit(real.join), 0
    state = empty_map(8, VOXEL_SIZE)
    kept: dict = {}
    for batch in FULL:
        before = set(read_map(state))
        state = join(state, batch.statistics(real.Statistics))
        rows = read_map(state)
        assert before <= set(rows)
        dropped += sum(voxel not in rows for voxel in batch.voxels)
        assert int(state.dropped) == dropped
        kept = rows
    assert len(kept) == 8
    assert dropped > 0


def test_maps_of_many_chunks_merge_and_grow(monkeypatch) -> None:
    monkeypatch.setattr(real, "JOINED", 4)
    batches = [Batch(seed, num_voxels=7) for seed in range(4)]
    a, b = map_of(batches[:2]), map_of(batches[2:])
    assert_same_rows(read_map(real.merge(a, b)), expected_rows(batches))
    assert_same_rows(read_map(real.grow(a, 64)), expected_rows(batches[:2]))


def test_drops_of_both_maps_add_up() -> None:
    a, b = map_of(FULL, capacity=8), map_of(FULL[:2], capacity=8)
    lost = len(set(read_map(b)) - set(read_map(a)))
    merged = real.merge(a, b)
    assert int(merged.dropped) == int(a.dropped) + int(b.dropped) + lost
    assert int(real.grow(a, 16).dropped) == int(a.dropped) > 0
    unchanged = real.merge(a, empty_map(8, VOXEL_SIZE))
    assert int(unchanged.dropped) == int(a.dropped)
