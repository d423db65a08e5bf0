"""Points join the map: Algorithms 1 and 2 against float64, and what must change nothing."""

import itertools

import jax
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from r3jax.kernels.constants import JOINED
from r3jax.mapping import update as real
from r3jax.mapping.join import grow, merge
from r3jax.mapping.state import empty_map
from r3jax.mapping.update import integrate_points
from tests.mapping.reference import assert_same_rows, read_map
from tests.mapping.sighted import (
    CAPACITY,
    assert_identical_rows,
    map_of,
    new_map,
    random_sighting,
    reference_of,
)
from tests.strategies import NUM_POINTS, VOXEL_SIZE, sightings

sequences = st.lists(sightings(), min_size=1, max_size=4)


@given(sequences)
def test_map_holds_the_statistics_of_all_frames(seen):
    reference = reference_of(seen)
    assume(reference.clearance > 1e-6)  # no camera midway between two bins
    assert_same_rows(read_map(map_of(seen)), reference.rows())


@given(sequences, st.randoms(use_true_random=False))
def test_order_of_frames_does_not_matter(seen, random):
    shuffled = random.sample(seen, len(seen))
    assert_same_rows(read_map(map_of(shuffled)), read_map(map_of(seen)))


@given(sightings(), st.permutations(range(NUM_POINTS)))
def test_order_of_points_does_not_matter(sighting, order):
    shuffled = sighting._replace(points=sighting.points[order], rgb=sighting.rgb[order])
    assert_same_rows(read_map(map_of([shuffled])), read_map(map_of([sighting])))


@given(sequences, sequences)
def test_merge_equals_one_sequence_and_commutes(first, second):
    merged = read_map(merge(map_of(first), map_of(second)))
    assert_same_rows(merged, read_map(map_of(first + second)))
    assert_same_rows(read_map(merge(map_of(second), map_of(first))), merged)


@settings(max_examples=15)
@given(sequences, sightings())
def test_growing_between_frames_changes_nothing(seen, last):
    grown = integrate_points(grow(map_of(seen), 4 * CAPACITY), *last)
    assert_identical_rows(grown, map_of([*seen, last]))


@given(sequences, st.tuples(*[st.integers(-5000, 5000)] * 3))
@example([random_sighting(0)], (64, 128, 64))
def test_shifting_the_world_by_whole_voxels_changes_nothing_but_the_keys(seen, shift):
    offset = (np.array(shift) * VOXEL_SIZE).astype(np.float32)
    moved = [s._replace(points=s.points + offset, position=s.position + offset) for s in seen]
    back = lambda voxel: tuple(i - by for i, by in zip(voxel, shift, strict=True))
    rows = {back(voxel): row for voxel, row in read_map(map_of(moved)).items()}
    expected = read_map(map_of(seen))
    assert rows.keys() == expected.keys()
    for voxel, row in expected.items():
        np.testing.assert_equal(rows[voxel]._asdict(), row._asdict())


@given(sequences, sightings())
def test_bins_and_resolution_only_grow(seen, last):
    before = map_of(seen)
    rows, later = read_map(before), read_map(integrate_points(before, *last))
    touched = {tuple(v) for v in np.floor(last.points / VOXEL_SIZE).astype(int).tolist()}
    assert later.keys() == rows.keys() | touched
    for voxel, row in rows.items():
        assert later[voxel].bins >= row.bins
        assert later[voxel].resolution >= row.resolution
        assert later[voxel].count == row.count + (voxel in touched)


@given(sequences)
def test_trace_equals_the_pairwise_form(seen):
    """Sum over pairs of |c_i - c_j|^2 = n tr(M), the identity behind the paper's two forms."""
    colors = reference_of(seen).colors
    for voxel, row in read_map(map_of(seen)).items():
        pairs = itertools.combinations(colors[voxel], 2)
        pairwise = sum(float(((a - b) ** 2).sum()) for a, b in pairs)
        assert row.count * row.m2 == pytest.approx(pairwise, rel=1e-4, abs=1e-5)


def test_many_pixels_of_one_voxel_are_one_observation():
    """Texture within a voxel is no noise: the mean counts, once."""
    checks = np.resize([0.0, 1.0], NUM_POINTS)[:, None] * np.ones(3)
    points = np.full((NUM_POINTS, 3), 0.01)
    state = integrate_points(new_map(), points, checks, np.array([1.0, 0.0, 0.0]), 100.0)
    (row,) = read_map(state).values()
    assert (row.count, row.m2, len(row.bins)) == (1.0, 0.0, 1)
    np.testing.assert_allclose(row.mean, 0.5)
    distance = np.linalg.norm([1.0 - 0.5 * VOXEL_SIZE, 0.5 * VOXEL_SIZE, 0.5 * VOXEL_SIZE])
    np.testing.assert_allclose(row.resolution, 100.0 / distance, rtol=1e-6)


def test_long_sequences_keep_their_precision():
    """300 frames of nearly one color: sums of squares would cancel, Welford's do not."""
    random = np.random.default_rng(2)
    seen = [random_sighting(i, reach=1) for i in range(300)]
    seen = [s._replace(rgb=np.float32(0.9 + 1e-3 * random.random((NUM_POINTS, 3)))) for s in seen]
    rows, expected = read_map(map_of(seen)), reference_of(seen).rows()
    assert max(row.count for row in rows.values()) > 250
    for voxel, row in expected.items():
        assert rows[voxel].count == row.count
        np.testing.assert_allclose(rows[voxel].mean, row.mean, rtol=1e-6)
        np.testing.assert_allclose(rows[voxel].m2, row.m2, rtol=1e-2)


def test_no_points_change_nothing():
    state = map_of([random_sighting(0)])
    nothing = np.zeros((0, 3), np.float32)
    assert integrate_points(state, nothing, nothing, np.zeros(3)) is state


def test_a_room_of_many_chunks_fits_in_10_mb():
    """A furnished 5 x 4 x 2.7 m room at 5 cm, its walls seen at once."""
    index = np.indices((100, 80, 54)).reshape(3, -1).T - [50, 40, 0]
    is_wall = ((index == [-50, -40, 0]) | (index == [49, 39, 53])).any(axis=1)
    table = (np.abs(index[:, :2]) < [20, 10]).all(axis=1) & (index[:, 2] == 15)
    voxels = index[is_wall | table]
    assert len(voxels) > 4 * JOINED
    points = np.repeat((voxels + 0.5) * 0.05, 2, axis=0).astype(np.float32)
    rgb = np.random.default_rng(0).random(points.shape).astype(np.float32)
    state = integrate_points(empty_map(), points, rgb, np.array([0.1, 0.2, 1.3]))
    assert int(state.num_occupied) == int(state.count.sum()) == len(voxels)
    assert int(state.dropped) == 0
    assert len(voxels) < 0.7 * state.capacity
    assert sum(leaf.nbytes for leaf in jax.tree.leaves(state)) < 10e6
    assert int(np.bitwise_count(np.asarray(state.visited)).sum()) == len(voxels)
    np.testing.assert_allclose(state.mean.sum(axis=1), rgb.sum(axis=0) / 2, rtol=1e-4)


def test_full_map_counts_what_it_drops_and_the_count_stays():
    seen = [random_sighting(seed) for seed in (0, 1, 2)]
    state, dropped = new_map(8), 0
    for sighting in seen:
        state = integrate_points(state, *sighting)
        voxels = {tuple(v) for v in np.floor(sighting.points / VOXEL_SIZE).astype(int).tolist()}
        rows = read_map(state)
        dropped += len(voxels - rows.keys())
        assert int(state.dropped) == dropped
    assert len(rows) == 8
    again = integrate_points(state, *seen[0]._replace(points=seen[0].points * 0 + 0.01))
    assert int(again.dropped) - dropped == ((0, 0, 0) not in rows)


GOOD = {
    "points_world": np.zeros((4, 3)),
    "rgb": np.full((4, 3), 0.5),
    "camera_position": np.ones(3),
    "focal": 1.0,
}


def with_point(value: float) -> np.ndarray:
    points = np.zeros((4, 3))
    points[2, 1] = value
    return points


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"points_world": np.zeros((4, 2))},
            r"points_world.*\(4, 2\)",
        ),
        ({"points_world": np.zeros(3)}, r"points_world.*\(3,\)"),
        ({"points_world": with_point(np.nan)}, "1 of 4.*number 2"),
        ({"points_world": with_point(np.inf)}, "1 of 4.*number 2"),
        ({"rgb": np.zeros((5, 3))}, r"rgb.*\(5, 3\)"),
        ({"rgb": np.zeros((4, 3), np.uint8)}, "uint8.*255"),
        ({"rgb": np.full((4, 3), 1.5)}, "rgb.*values from 1.5 to 1.5"),
        ({"rgb": np.full((4, 3), -0.1)}, "rgb.*values from -0.1"),
        ({"rgb": np.full((4, 3), np.nan)}, "rgb"),
        (
            {"camera_position": np.ones((3, 1))},
            r"camera_position.*\(3, 1\)",
        ),
        ({"camera_position": np.array([0.0, np.nan, 0.0])}, "camera_position is not finite"),
        ({"focal": 0.0}, "focal.*0.0"),
        ({"focal": -3.0}, "focal"),
        ({"focal": np.nan}, "focal"),
        ({"focal": np.inf}, "focal"),
        ({"focal": np.ones(2)}, r"focal.*shape \(2,\)"),
    ],
)
def test_bad_input_is_named(changes, words):
    state = new_map()
    integrate_points(state, **GOOD)
    with pytest.raises(ValueError, match=words):
        integrate_points(state, **(GOOD | changes))


# Laws of fixed examples ---------------------------------------------------------------------------

SEEN = [random_sighting(seed) for seed in range(10, 14)]


def test_points_of_many_chunks(monkeypatch) -> None:
    monkeypatch.setattr(real, "JOINED", 4)
    reference = reference_of(SEEN)
    assert reference.clearance > 1e-6
    assert_same_rows(read_map(map_of(SEEN, real.integrate_points)), reference.rows())


def test_points_that_are_not_finite_are_padding_under_jit() -> None:
    """Points without a measurement, and whatever color they have, take no part."""
    add = jax.jit(real.integrate_points)
    sighting = SEEN[0]
    bad = np.resize(np.array([np.nan, 0.0, np.inf, -np.inf, 0.0], np.float32), (10, 3))
    padded = sighting._replace(
        points=np.concatenate([bad[:5], sighting.points, bad[5:]]),
        rgb=np.concatenate([np.ones((5, 3)), sighting.rgb, np.zeros((5, 3))], dtype=np.float32),
    )
    assert_identical_rows(add(new_map(), *padded), map_of([sighting]))
