"""The room that scoring makes for voxels and cells at hand: enough, and seldom of another size."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.scoring import gather as real

CAPACITY, CELLS = 1 << 23, 2_918_208  # a hall of 60 x 60 x 6 m


def law_of_room(voxels: int = 70_000, cells: int = 300_000) -> None:
    sizes_of = real._sizes
    room, cell_room = sizes_of(voxels, cells, CAPACITY, CELLS)
    assert voxels <= room <= max(real.SMALLEST, 4 * voxels)
    assert cells <= cell_room <= CELLS
    # Never more than there can be.
    assert sizes_of(voxels, 50, max(voxels, 1), 60) == (min(room, max(voxels, 1)), 60)


@given(st.integers(0, CAPACITY), st.integers(0, CELLS))
def test_there_is_room(voxels, cells):
    law_of_room(voxels, cells)


def test_few() -> None:
    """However maps and views vary: six sizes of voxels, two of cells with each at most."""
    counts = [0, *(round(1.3**k) for k in range(64))]
    sizes = {
        real._sizes(min(voxels, CAPACITY), min(cells, CELLS), CAPACITY, CELLS)
        for voxels, cells in itertools.product(counts, counts)
    }
    assert 6 <= len(sizes) <= 11


@pytest.mark.parametrize("count", [0, 1, real.SMALLEST, real.SMALLEST + 1])
def test_the_smallest_room_is_the_same_for_all(count):
    room, _ = real._sizes(count, 0, CAPACITY, CELLS)
    assert room == (real.SMALLEST if count <= real.SMALLEST else 4 * real.SMALLEST)
