"""What a map's colors average: R of the voxels that a position sees, and of no others."""

import jax.numpy as jnp
import numpy as np
import pytest

import r3jax
from r3jax.apps.viewer.terms import probe_positions, surface_terms
from r3jax.apps.viewer.timeline import Timeline
from r3jax.scoring.config import ScoringConfig
from r3jax.visibility.depth_buffer import candidates_of, depth_buffer, visible_voxels
from r3jax.visibility.views import panorama_view

pytestmark = pytest.mark.full

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
    voxels, view = state, panorama_view(jnp.asarray(places[0]), config)
    candidates = candidates_of(voxels, view)
    buffer = depth_buffer(voxels, candidates, view, config)
    visible = np.asarray(visible_voxels(voxels, candidates, view, buffer).mask)
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


def test_no_position_sees_nothing(moment, run):
    terms = surface_terms(moment.map_state, run.camera, np.zeros((0, 3)), ScoringConfig(), pad_to=2)
    assert (np.asarray(terms.sightings) == 0.0).all()
    assert (np.asarray(terms.value) == 0.0).all()


def test_probes_stand_in_known_free_space(moment):
    positions = probe_positions(moment.grid, 6)
    assert 1 <= len(positions) <= 6
    cells = np.floor((positions - np.asarray(moment.grid.origin)) / float(moment.grid.cell_size))
    assert np.asarray(moment.grid.free)[tuple(cells.astype(int).T)].all()
