"""Scans of a moving sensor join the map: one position per point, padded to one length."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from r3jax.mapping import update as real
from r3jax.mapping.state import MapState
from r3jax.mapping.update import integrate_points
from tests.mapping.reference import ReferenceMap, assert_same_rows, read_map
from tests.mapping.sighted import NUM_BINS, new_map, random_sighting
from tests.strategies import NUM_POINTS, VOXEL_SIZE, Sighting, sightings

PADDED = 32
"""Points that every call is padded to: one shape, one compile."""


class Scan(NamedTuple):
    """A sighting whose points each have a sensor position of their own."""

    points: np.ndarray
    rgb: np.ndarray
    positions: np.ndarray
    """[NUM_POINTS, 3] float32 [m]."""

    focal: float


@st.composite
def scans(draw: st.DrawFn) -> Scan:
    seen = draw(sightings())
    steps = draw(hnp.arrays(np.int8, (NUM_POINTS, 3), elements=st.integers(-64, 64)))
    return moving(seen, steps)


def moving(seen: Sighting, steps: np.ndarray) -> Scan:
    """The sensor strays from the sighting's position by steps of 1/256 m: float32 holds it all."""
    positions = (seen.position + steps / 256).astype(np.float32)
    return Scan(seen.points, seen.rgb, positions, seen.focal)


def padded(scan: Scan, seed: int = 0) -> tuple[dict[str, object], dict[str, object]]:
    """What `integrate_points` takes: the scan's points, with rubbish strewn in between."""
    random = np.random.default_rng(seed)
    place = np.sort(random.permutation(PADDED)[:NUM_POINTS])
    valid = np.zeros(PADDED, dtype=bool)
    valid[place] = True
    rubbish = np.array([0.03, 0.03, 0.03, 0.03, np.nan, np.inf], np.float32)
    arrays = [random.choice(rubbish, (PADDED, 1)).repeat(3, axis=1) for _ in range(3)]
    for array, content in zip(arrays, (scan.points, scan.rgb, scan.positions), strict=True):
        array[place] = content
    points, rgb, positions = arrays
    arguments = {"points_world": points, "rgb": rgb, "camera_position": positions}
    return arguments | {"focal": scan.focal}, {"valid": valid}


def map_of(seen: list[Scan], add=integrate_points, capacity: int = 128) -> MapState:
    state = new_map(capacity)
    for scan in seen:
        arguments, mask = padded(scan)
        state = add(state, **arguments, **mask)
    return state


def reference_of(seen: list[Scan]) -> ReferenceMap:
    reference = ReferenceMap(VOXEL_SIZE, NUM_BINS)
    for scan in seen:
        reference.see(*scan)
    return reference


sequences = st.lists(scans(), min_size=1, max_size=3)


@given(sequences)
def test_map_holds_the_statistics_of_all_scans(seen):
    reference = reference_of(seen)
    assume(reference.clearance > 1e-5)  # no sensor midway between two bins
    assert_same_rows(read_map(map_of(seen)), reference.rows())


@given(sequences, st.randoms(use_true_random=False))
def test_order_of_scans_does_not_matter(seen, random):
    assume(reference_of(seen).clearance > 1e-5)
    shuffled = random.sample(seen, len(seen))
    assert_same_rows(read_map(map_of(shuffled)), read_map(map_of(seen)))


@given(scans(), st.permutations(range(NUM_POINTS)))
def test_order_of_points_does_not_matter(scan, order):
    assume(reference_of([scan]).clearance > 1e-5)
    shuffled = Scan(*(array[order] for array in scan[:3]), scan.focal)
    assert_same_rows(read_map(map_of([shuffled])), read_map(map_of([scan])))


@given(sightings())
def test_a_sensor_that_stands_still_is_a_camera(seen):
    still = moving(seen, np.zeros((NUM_POINTS, 3)))
    assume(reference_of([still]).clearance > 1e-6)
    camera = integrate_points(new_map(), *seen)
    assert_same_rows(read_map(map_of([still])), read_map(camera))


def test_padding_takes_no_part_and_need_not_compile_again():
    scan = EXAMPLES[0]
    alone = integrate_points(new_map(), *scan)
    before = real._integrate_points._cache_size()
    for seed in range(3):
        arguments, mask = padded(scan, seed)
        assert_same_rows(
            read_map(integrate_points(new_map(), **arguments, **mask)), read_map(alone)
        )
    assert real._integrate_points._cache_size() <= before + 1


def test_masks_may_be_traced():
    arguments, mask = padded(EXAMPLES[0])
    scan = jax.jit(lambda state, valid: integrate_points(state, **arguments, valid=valid))
    traced = scan(new_map(), jnp.asarray(mask["valid"]))
    assert_same_rows(read_map(traced), read_map(map_of(EXAMPLES[:1])))


def test_nothing_but_padding_changes_nothing():
    before = map_of(EXAMPLES)
    arguments, _ = padded(EXAMPLES[0])
    after = integrate_points(before, **arguments, valid=np.zeros(PADDED, dtype=bool))
    jax.tree.map(np.testing.assert_array_equal, after, before)


def test_full_map_counts_what_it_drops():
    state, dropped = new_map(8), 0
    for scan in EXAMPLES:
        arguments, mask = padded(scan)
        state = integrate_points(state, **arguments, **mask)
        voxels = {tuple(v) for v in np.floor(scan.points / VOXEL_SIZE).astype(int).tolist()}
        rows = read_map(state)
        dropped += len(voxels - rows.keys())
        assert int(state.dropped) == dropped > 0
    assert len(rows) == 8


def test_resolution_of_a_scanner_is_points_per_meter():
    """Rays one step apart hit a sphere round the scanner as far apart as the resolution says."""
    step, distance = np.deg2rad(0.5), 2.0
    azimuth = step * (np.arange(NUM_POINTS) - 0.5 * NUM_POINTS)
    ring = distance * np.stack([np.cos(azimuth), np.sin(azimuth), 0.02 + 0.0 * azimuth], axis=1)
    spacing = np.linalg.norm(np.diff(ring, axis=0), axis=1).mean()
    state = integrate_points(new_map(), ring, np.ones((NUM_POINTS, 3)), np.zeros(3), 1.0 / step)
    resolutions = [row.resolution for row in read_map(state).values()]
    assert len(resolutions) > 3
    # A voxel's center lies up to 0.054 m from its points.
    np.testing.assert_allclose(resolutions, 1.0 / spacing, rtol=0.03)


BAD = {
    "positions of other points": ({"camera_position": np.ones((3, 3))}, r"\[3\] or the points'"),
    "position not finite": (
        {"camera_position": np.array([[1.0, 1, 1], [1, np.nan, 1], [1, 1, 1], [1, 1, 1]])},
        "camera_position is not finite: .*nan",
    ),
    "mask of other points": ({"valid": np.ones(3, bool)}, r"valid must be \[4\] bool, got bool"),
    "mask of numbers": ({"valid": np.ones(4)}, r"valid must be \[4\] bool, got float32"),
    "point not finite": ({"points_world": np.full((4, 3), np.nan)}, "3 of 4 points are not finite"),
    "color out of range": ({"rgb": np.full((4, 3), 2.0)}, r"rgb must lie in \[0, 1\]"),
}


@pytest.mark.parametrize(("changes", "words"), BAD.values(), ids=BAD.keys())
def test_bad_scan_is_named(changes, words):
    good = {
        "points_world": np.zeros((4, 3)),
        "rgb": np.full((4, 3), 0.5),
        "camera_position": np.ones((4, 3)),
        "valid": np.array([True, True, False, True]),
    }
    integrate_points(new_map(), **good)
    with pytest.raises(ValueError, match=words):
        integrate_points(new_map(), **(good | changes))


# Laws of fixed examples ---------------------------------------------------------------------------

EXAMPLES = [
    moving(random_sighting(seed), np.random.default_rng(seed).integers(-64, 64, (NUM_POINTS, 3)))
    for seed in range(20, 23)
]


def test_scans_of_many_chunks(monkeypatch) -> None:
    """With chunks smaller than a scan, so that leaders and their positions stay together."""
    monkeypatch.setattr(real, "JOINED", 4)
    reference = reference_of(EXAMPLES)
    assert reference.clearance > 1e-5
    assert_same_rows(read_map(map_of(EXAMPLES, real.integrate_points)), reference.rows())


def test_unknown_position() -> None:
    """Under jit a point whose sensor position is not known takes no part."""
    scan = EXAMPLES[0]
    positions = scan.positions.copy()
    positions[::3] = np.nan
    known = np.isfinite(positions).all(axis=1)
    add = jax.jit(real.integrate_points)
    state = add(new_map(), *scan[:2], positions, scan.focal)
    reference = reference_of([Scan(*(array[known] for array in scan[:3]), scan.focal)])
    assert reference.clearance > 1e-5
    assert_same_rows(read_map(state), reference.rows())
