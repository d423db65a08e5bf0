"""Laws of merging voxels into blocks, on random maps of one capacity.

What a map's colors average: R of the voxels that a position sees, and of no others.
"""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import r3jax
from r3jax.apps.viewer.drawing import (
    QUANTITIES,
    UNSEEN,
    SurfaceTerms,
    block_colors,
    block_values,
    blocks_of,
    probe_positions,
    surface_terms,
)
from r3jax.apps.viewer.story import Timeline
from r3jax.geometry.voxels import INDEX_LIMIT
from r3jax.mapping.seen import visible_rows
from r3jax.mapping.state import MapState, empty_map
from r3jax.scoring.config import ScoringConfig
from r3jax.visibility.views import panorama_view

FIELDS = ("value", "bias", "noise", "resolution")


@pytest.fixture(scope="module")
def moment(run):
    return Timeline(run).at(len(run.rows) - 1)


@pytest.fixture(scope="module")
def places(run):
    return np.stack([run.rows[0].pose[:3, 3], run.rows[-1].pose[:3, 3] + np.float32(0.05)])


def one(moment, run, place):
    return surface_terms(moment.map_state, run.camera, place[None], ScoringConfig(), pad_to=2)


def test_one_position_gives_the_closed_form_where_it_sees(moment, run, places):
    terms = one(moment, run, places[0])
    seen = np.asarray(terms.sightings) > 0
    config, state = ScoringConfig(), moment.map_state
    view = panorama_view(jnp.asarray(places[0]), config)
    visible = np.asarray(visible_rows(state, view, config))
    np.testing.assert_array_equal(seen, visible)
    assert 100 < seen.sum() < np.asarray(state.occupied).sum()
    expected = r3jax.voxel_renderability(state, places[0], run.camera.focal)
    for name in FIELDS:
        value = np.asarray(getattr(terms, name))
        np.testing.assert_allclose(
            value[seen], np.asarray(getattr(expected, name))[seen], atol=1e-5
        )
        assert (value[~seen] == 0.0).all()


def test_two_positions_give_the_mean_over_those_that_see(moment, run, places):
    first, second = (one(moment, run, place) for place in places)
    both = surface_terms(moment.map_state, run.camera, places, ScoringConfig(), pad_to=2)
    count = np.asarray(first.sightings) + np.asarray(second.sightings)
    np.testing.assert_array_equal(both.sightings, count)
    for name in FIELDS:
        total = sum(np.asarray(getattr(t, name)) * np.asarray(t.sightings) for t in (first, second))
        mean = total / np.maximum(count, 1.0)
        np.testing.assert_allclose(np.asarray(getattr(both, name)), mean, atol=1e-6)


def test_probes_stand_in_known_free_space(moment):
    positions = probe_positions(moment.grid, 6)
    assert 1 <= len(positions) <= 6
    cells = np.floor((positions - np.asarray(moment.grid.origin)) / float(moment.grid.cell_size))
    assert np.asarray(moment.grid.free)[tuple(cells.astype(int).T)].all()


CAPACITY, SIZE = 64, 0.5

indices = st.sets(st.tuples(*[st.integers(-9, 9)] * 3), max_size=40).map(sorted)


def words_of(index) -> np.ndarray:
    """The packed keys of voxels, [2, n]: 21 bits each of x, y and z."""
    x, y, z = (np.array(index, np.int64).reshape(-1, 3) + INDEX_LIMIT).T
    key = x | (y << 21) | (z << 42)
    return np.stack([key & 0xFFFFFFFF, key >> 32]).astype(np.uint32)


def map_of(index) -> MapState:
    """A map with these voxels, in rows at random."""
    state, rng = empty_map(CAPACITY, SIZE), np.random.default_rng(len(index))
    rows = rng.permutation(CAPACITY)[: len(index)]
    key, count = np.array(state.key), np.array(state.count)
    key[:, rows], count[rows] = words_of(index), 1.0
    return MapState(
        key=jnp.asarray(key),
        visited=state.visited,
        count=jnp.asarray(count),
        mean=jnp.asarray(rng.random((3, CAPACITY)), jnp.float32),
        m2=state.m2,
        resolution=state.resolution,
        voxel_size=state.voxel_size,
        dropped=state.dropped,
        num_bins=state.num_bins,
    )


def centers(index) -> np.ndarray:
    return (np.array(index, np.float64).reshape(-1, 3) + 0.5) * SIZE


@given(indices)
def test_with_room_for_all_every_voxel_is_a_block(index):
    blocks = blocks_of(map_of(index), CAPACITY)
    assert blocks.edge == SIZE
    found = sorted(map(tuple, blocks.centers.round(4).tolist()))
    assert found == sorted(map(tuple, centers(index).round(4).tolist()))


@given(indices, st.integers(1, 20))
def test_blocks_fit_the_budget_and_stand_for_all_voxels(index, budget):
    state = map_of(index)
    blocks = blocks_of(state, budget)
    assert len(blocks.centers) <= budget
    assert blocks.num_voxels == len(index) == len(blocks.block_of)
    assert set(blocks.block_of.tolist()) == set(range(len(blocks.centers)))


@given(indices, st.integers(1, 20))
def test_a_block_is_the_mean_of_voxels_in_one_cube(index, budget):
    state = map_of(index)
    blocks = blocks_of(state, budget)
    lookup = dict(zip(map(tuple, words_of(index).T.tolist()), index, strict=True))
    words = np.asarray(state.key)[:, blocks.rows].T.tolist()
    voxels = np.array([lookup[tuple(word)] for word in words]).reshape(-1, 3)
    for number, center in enumerate(blocks.centers):
        mine = voxels[blocks.block_of == number]
        np.testing.assert_allclose(center, centers(mine).mean(axis=0), atol=1e-5)
        cubes = {tuple(c) for c in ((mine + INDEX_LIMIT) // round(blocks.edge / SIZE)).tolist()}
        assert len(cubes) == 1


@given(indices, st.integers(1, 20))
def test_means_keep_the_total(index, budget):
    state = map_of(index)
    blocks = blocks_of(state, budget)
    values = np.random.default_rng(0).random(CAPACITY)
    count = np.bincount(blocks.block_of, minlength=len(blocks.centers))
    total = float((blocks.mean(values) * count).sum())
    assert total == pytest.approx(float(values[blocks.rows].sum()))


def terms_of(value, sightings) -> SurfaceTerms:
    rows = [jnp.asarray(x, jnp.float32) for x in (value, sightings)]
    return SurfaceTerms(rows[0], rows[0], rows[0], rows[0], rows[1])


def test_what_no_position_sees_is_gray_and_does_not_count():
    state = map_of([(0, 0, 0), (1, 0, 0), (8, 0, 0)])
    blocks = blocks_of(state, 2)
    rows, where = blocks.rows, blocks.centers[:, 0].argsort()
    order = np.asarray(blocks.block_of)
    near = rows[order == where[0]]
    value, sightings = np.full(CAPACITY, 0.25), np.zeros(CAPACITY)
    value[near[0]], sightings[near[0]] = 1.0, 3.0
    values = block_values(blocks, terms_of(value, sightings), "renderability")
    assert values[where[0]] == 1.0
    assert np.isnan(values[where[1]])
    colors = block_colors(blocks, state, terms_of(value, sightings), "bias")
    assert tuple(colors[where[1]]) == UNSEEN
    assert colors[where[0], 1] > colors[where[0], 0]  # green


def test_every_quantity_has_a_color_for_every_block():
    state = map_of([(0, 0, 0), (3, 2, 1)])
    blocks = blocks_of(state, 10)
    terms = terms_of(np.full(CAPACITY, 0.5), np.ones(CAPACITY))
    for quantity in QUANTITIES:
        assert block_colors(blocks, state, terms, quantity).shape == (2, 3)
    seen = block_colors(blocks, state, None, "color")
    expected = np.rint(np.asarray(state.mean).T[blocks.rows] * 255.0)
    np.testing.assert_array_equal(seen[blocks.block_of], expected)


def test_an_empty_map_has_no_block():
    blocks = blocks_of(map_of([]), 5)
    assert blocks.centers.shape == (0, 3)
    assert blocks.edge == SIZE
    assert block_colors(blocks, map_of([]), None, "color").shape == (0, 3)
