"""Paths of recorded runs: as long as flown, corners included, and none leads from run to run."""

import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from r3jax.runs.rows import paths_to, piece_of_path
from tests.runs.runs import make_flight

places = st.integers(2, 4).flatmap(
    lambda num: arrays(np.float64, (num, 3), elements=st.floats(-3.0, 3.0, width=16))
)
runs = st.lists(st.tuples(places, st.integers(1, 4)), max_size=3)


@given(st.lists(st.tuples(runs, st.integers(1, 12)), min_size=1, max_size=3))
def test_paths_are_as_long_as_flown_and_none_leads_to_a_run(flights):
    """Each run is cut off after some rows, often on the way; one is merged behind the other."""
    rows = []
    for legs, num in flights:
        rows += make_flight(legs, rows[-1] if rows else None)[:num]
    paths = list(paths_to(rows))
    begins = np.cumsum([0] + [min(num, sum(n for _, n in legs) + 1) for legs, num in flights])
    assert [i for i, path in enumerate(paths) if path is None] == begins[:-1].tolist()
    for (before, row), path in zip(itertools.pairwise(rows), paths[1:], strict=True):
        if path is None:
            assert row.metres == before.metres
            continue
        length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
        np.testing.assert_allclose(length, row.metres - before.metres, atol=1e-3)
        np.testing.assert_array_equal(path[[0, -1]], [before.pose[:3, 3], row.pose[:3, 3]])


def test_a_corner_between_two_frames_by_hand():
    """0.3 m along x, then 0.5 m along y: the first of two pieces of 0.4 m turns the corner."""
    corner = np.array([[0.0, 0.0, 1.0], [0.3, 0.0, 1.0], [0.3, 0.5, 1.0]])
    start, first, second = paths_to(make_flight([(corner, 2)]))
    assert start is None
    np.testing.assert_allclose(first, [[0, 0, 1], [0.3, 0, 1], [0.3, 0.1, 1]], atol=1e-6)
    np.testing.assert_allclose(second, [[0.3, 0.1, 1], [0.3, 0.5, 1]], atol=1e-6)


@given(
    arrays(np.float64, (4, 3), elements=st.floats(-3.0, 3.0, width=16)),
    st.lists(st.floats(0.0, 1.0), min_size=1, max_size=4),
)
def test_the_pieces_of_a_path_are_the_path(waypoints, shares):
    length = float(np.linalg.norm(np.diff(waypoints, axis=0), axis=1).sum())
    cuts = length * np.sort([0.0, *shares, 1.0])
    pieces = [piece_of_path(waypoints, a, b) for a, b in itertools.pairwise(cuts)]
    np.testing.assert_allclose(pieces[0][0], waypoints[0], atol=1e-9)
    np.testing.assert_allclose(pieces[-1][-1], waypoints[-1], atol=1e-9)
    for before, after in itertools.pairwise(pieces):
        np.testing.assert_allclose(before[-1], after[0], atol=1e-9)
    lengths = [np.linalg.norm(np.diff(piece, axis=0), axis=1).sum() for piece in pieces]
    # Bends within a tenth of a millimeter of an end are left to it.
    np.testing.assert_allclose(lengths, np.diff(cuts), atol=1e-3)
