"""The forecast of a small room: from its own views, and higher the more is known."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.apps.forecast import forecast as real
from r3jax.apps.forecast.forecast import forecast_map, free_space_views, view_features
from r3jax.apps.forecast.psnr import default_calibration, read_calibration, write_calibration
from r3jax.exploration.config import ExplorationConfig
from r3jax.geometry.cameras import pose_along
from r3jax.mapping.state import empty_map
from r3jax.planning.planner import add_frame, first_grid
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.renderability import renderability
from tests.exploration.toys import BoxRoom

CONFIG = ExplorationConfig(voxel_size=0.1, capacity=1 << 14)


@pytest.fixture(scope="module")
def known():
    """The box room after 1, 4 and 12 views from its middle: camera, and map and grid of each."""
    room = BoxRoom()
    state = empty_map(CONFIG.capacity, CONFIG.voxel_size, CONFIG.num_bins)
    grid = first_grid(room.bounds, [room.start_pose], CONFIG)
    found = {}
    for view in range(12):
        angle = 2.0 * np.pi * view / 4.0
        direction = np.array([np.cos(angle), np.sin(angle), 0.6 * (view // 4 - 1)])
        position = np.array([1.8 + 0.3 * (view % 2), 1.5, 1.2])
        pose = pose_along(position.astype(np.float32), direction.astype(np.float32))
        frame = room.render(np.asarray(pose, np.float64))
        state, grid = add_frame(state, grid, frame, CONFIG)
        found[view + 1] = state, grid
    return room.camera, {views: found[views] for views in (1, 4, 12)}


def test_more_views_promise_more(known):
    camera, states = known
    values = [real.forecast_map(*states[views], camera).value("mean") for views in (1, 4, 12)]
    assert values[0] + 2.0 < values[1] < values[2]


def test_a_forecast_is_the_mixture_of_its_views(known):
    """Its views one by one: R and coverage of each, and the mixture of all that show something."""
    camera, states = known
    state, grid = states[12]
    few = np.full(grid.log_odds.shape, 4.0, np.float32)  # so few that padding matters
    few[6:11, 6:11, 5:9] = -4.0
    grid = eqx.tree_at(lambda g: g.log_odds, grid, jnp.asarray(few))
    poses = free_space_views(grid, real.NUM_VIEWS)
    assert 30 < len(poses) < real.NUM_VIEWS
    config = ScoringConfig(max_range=5.0)
    coverage, value = view_features(state, camera, jnp.asarray(poses), config)
    alone = [float(renderability(state, camera, pose, config)) for pose in jnp.asarray(poses)]
    np.testing.assert_allclose(value, alone, atol=1e-5)
    assert (value <= coverage + 1e-6).all()
    forecast = real.forecast_map(state, grid, camera)
    model = default_calibration().model
    expected = np.sort(model.mixture(coverage, value), axis=None)
    assert forecast.mixture.shape == expected.shape
    np.testing.assert_allclose(forecast.mixture, expected, atol=1e-3)


def test_a_view_into_the_void_does_not_count(known):
    """A view that shows no surface counts as a failure only while there may be some."""
    camera, states = known
    state, grid = states[12]
    done = jnp.where(grid.unexplored, 4.0, grid.log_odds).astype(jnp.float32)
    open_grid = eqx.tree_at(lambda g: g.log_odds, grid, done)
    forecast = real.forecast_map(empty_map(*_size(state)), open_grid, camera)
    assert forecast.mixture.size == 0
    assert forecast.value("mean") == -np.inf
    blamed = real.forecast_map(empty_map(*_size(state)), grid, camera)
    assert blamed.mixture.size > 0


def _size(state):
    return state.capacity, float(state.voxel_size), CONFIG.num_bins


def test_a_width_goes_both_ways(known):
    camera, states = known
    forecast = forecast_map(*states[4], camera)
    low, high = forecast.interval("p10", 0.8)
    width = default_calibration().half_width("p10", 0.8)
    assert (high - low) / 2.0 == pytest.approx(width)
    assert (high + low) / 2.0 == pytest.approx(forecast.value("p10"))


def test_nothing_known_forecasts_nothing():
    room = BoxRoom()
    grid = first_grid(room.bounds, [], CONFIG)
    state = empty_map(CONFIG.capacity, CONFIG.voxel_size, CONFIG.num_bins)
    assert forecast_map(state, grid, room.camera).value("mean") == -np.inf


def test_a_sweep_of_places_compiles_once(known):
    camera, states = known
    forecast_map(*states[4], camera)
    compiled = real._features._cache_size()
    for views in (1, 12):
        forecast_map(*states[views], camera, max_range=3.0 + views)
    assert real._features._cache_size() == compiled


def test_a_calibration_is_read_as_it_was_written(tmp_path):
    path = tmp_path / "mine.json"
    write_calibration(path, default_calibration())
    assert read_calibration(path) == default_calibration()


def test_a_file_that_is_no_calibration_is_told(tmp_path):
    path = tmp_path / "mine.json"
    path.write_text('{"format": 1, "source": "me"}')
    with pytest.raises(ValueError, match=r"mine\.json: `calibration` .*errors, location"):
        read_calibration(path)
    write_calibration(path, default_calibration())
    path.write_text(path.read_text().replace('"format": 1', '"format": 2'))
    with pytest.raises(ValueError, match="format version 2"):
        read_calibration(path)
