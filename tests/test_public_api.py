"""The public calls, as a reader of the documentation writes them."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import r3jax

CAPACITY = 1 << 12
SIDE = 48  # pixels of the frame
NUM_BINS = 526


def make_frame(camera: r3jax.Camera, x: float) -> r3jax.Frame:
    """A picture of the wall y = 2 with a step in it, from x along +y."""
    pose = r3jax.pose_along(jnp.array([x, 0.0, 1.0]), jnp.array([0.0, 1.0, 0.0]))
    depth = np.full((SIDE, SIDE), 2.0, dtype=np.float32)
    depth[:, SIDE // 2 :] = 1.5
    depth[:4] = 0.0
    rgb = np.random.default_rng(0).random((SIDE, SIDE, 3)).astype(np.float32)
    return r3jax.Frame(rgb, depth, pose, camera)


@pytest.fixture(scope="module")
def camera():
    return r3jax.Camera.from_fov(SIDE, SIDE, 60.0)


@pytest.fixture(scope="module")
def frame(camera):
    return make_frame(camera, 0.0)


@pytest.fixture(scope="module")
def m(camera, frame):
    m = r3jax.empty_map(capacity=CAPACITY, voxel_size=0.05)
    m = r3jax.integrate(m, frame)
    return r3jax.integrate(m, make_frame(camera, 0.3))


@pytest.fixture(scope="module")
def grid(frame):
    grid = r3jax.empty_grid(np.array([[-2.0, -1.0, 0.0], [2.0, 3.0, 2.0]]))
    return r3jax.integrate_depth(grid, frame)


@pytest.fixture(scope="module")
def poses(frame):
    shifts = jnp.array([[0.0, 0.0, 0.0], [0.1, 0.05, -0.1], [-0.2, 0.0, 0.1]])
    return jax.vmap(lambda shift: frame.T_world_camera.at[:3, 3].add(shift))(shifts)


def test_an_empty_map_has_the_documented_defaults():
    m = r3jax.empty_map(capacity=1 << 17, voxel_size=0.05)
    assert (m.capacity, m.num_bins, int(m.num_occupied)) == (1 << 17, 64, 0)
    assert m.bytes_per_row <= 48
    assert float(m.voxel_size) == pytest.approx(0.05)


def test_frames_and_points_join_the_map(m, frame):
    assert int(m.num_occupied) > 200
    points_world = jnp.array([[0.51, 0.52, 0.53], [0.51, 0.52, 0.54], [1.01, 0.0, 0.0]])
    rgb = jnp.full((3, 3), 0.5)
    more = r3jax.integrate_points(m, points_world, rgb, frame.position, focal=1.0)
    assert int(more.num_occupied) == int(m.num_occupied) + 2
    rows = r3jax.lookup(more, points_world)
    assert rows.shape == (3,)
    assert int(rows[0]) == int(rows[1]) < m.capacity
    assert (np.asarray(r3jax.lookup(m, points_world)) == m.capacity).all()


def test_voxel_renderability_has_every_term_per_row(m, frame):
    t = r3jax.voxel_renderability(m, frame.position, focal=1.0)
    for term in (t.kappa, t.bias, t.delta, t.noise, t.resolution, t.value):
        assert term.shape == (m.capacity,)
        assert np.isfinite(term).all()
    assert (np.asarray(t.value)[~np.asarray(m.occupied)] == 0.0).all()
    assert float(t.value.max()) <= 1.0
    assert float(t.value[np.asarray(m.occupied)].mean()) > 0.5


def test_positions_may_be_any_array_and_focal_lengths_any_number(m, frame):
    expected = np.asarray(r3jax.voxel_renderability(m, frame.position, focal=2.0).value)
    position = np.asarray(frame.position)
    for where, focal in ((position, 2), (position.astype(np.float64), np.float32(2.0))):
        value = np.asarray(r3jax.voxel_renderability(m, where, focal=focal).value)
        np.testing.assert_array_equal(value, expected)


def test_malformed_queries_are_refused(m, frame):
    with pytest.raises(ValueError, match=r"shape \[3\]"):
        r3jax.voxel_renderability(m, jnp.zeros(4))
    with pytest.raises(ValueError, match="one number"):
        r3jax.voxel_renderability(m, frame.position, focal=jnp.ones(2))
    with pytest.raises(ValueError, match="kappa"):
        r3jax.voxel_renderability(m, frame.position, kappa="two")


def test_a_view_is_the_mean_of_its_image(m, camera, frame):
    s = r3jax.renderability(m, camera, frame.T_world_camera)
    i = r3jax.renderability_image(m, camera, frame.T_world_camera)
    assert s.shape == ()
    assert i.shape == (SIDE, SIDE)
    assert float(s) == pytest.approx(float(i.mean()), abs=1e-6)
    assert 0.4 < float(s) <= 1.0
    away = frame.T_world_camera.at[:3, :3].multiply(jnp.array([[-1.0, 1.0, -1.0]]))
    assert float(r3jax.renderability(m, camera, away)) == 0.0


def test_views_are_scored_over_poses(m, camera, poses):
    score = functools.partial(r3jax.renderability, m, camera)
    scores = jax.jit(jax.vmap(score))(poses)
    single = [float(score(pose)) for pose in poses]
    np.testing.assert_allclose(scores, single, atol=1e-6)


def test_a_utility_is_the_weighted_sum_of_its_parts(m, grid, camera, frame):
    config = r3jax.ScoringConfig(lambda1=3.0)
    u = r3jax.view_utility(m, grid, camera, frame.T_world_camera, config)
    assert float(u.total) == pytest.approx(3.0 * float(u.exploration) + float(u.rendering))
    assert float(u.exploration) == round(float(u.exploration))
    assert float(u.rendering) > 0.0


def test_a_panorama_scores_all_directions(m, grid, camera, frame):
    config = r3jax.ScoringConfig()
    p = r3jax.panorama(m, grid, camera, frame.position, config)
    assert p.bin_scores.shape == p.direction_scores.shape == (NUM_BINS,)
    assert float(p.best_score) == float(p.direction_scores.max())
    assert float(jnp.linalg.norm(p.best_direction)) == pytest.approx(1.0, abs=1e-6)
    np.testing.assert_allclose(p.T_world_camera[:3, 2], p.best_direction, atol=1e-6)
    np.testing.assert_array_equal(p.T_world_camera[:3, 3], frame.position)


def assert_differentiates(score, where):
    gradient = np.asarray(jax.grad(score)(where))
    assert np.isfinite(gradient).all()
    assert np.abs(gradient).max() > 0.0


def test_scores_differentiate_with_respect_to_the_pose(m, grid, camera, frame):
    config = r3jax.ScoringConfig()
    utility = lambda pose: r3jax.view_utility(m, grid, camera, pose, config).total
    assert_differentiates(lambda pose: r3jax.renderability(m, camera, pose), frame.T_world_camera)
    assert_differentiates(utility, frame.T_world_camera)


@pytest.mark.slow
def test_a_panorama_differentiates_with_respect_to_the_position(m, grid, camera, frame):
    config = r3jax.ScoringConfig()
    best = lambda position: r3jax.panorama(m, grid, camera, position, config).best_score
    assert_differentiates(best, frame.position)


def test_a_sweep_over_settings_and_poses_compiles_once(m, grid, camera, poses):
    before = r3jax.view_utility.__wrapped__._cache_size()
    for lambda1, max_range, pose in zip((1.0, 2.0, 7.5), (5.0, 3.0, 4.0), poses, strict=True):
        config = r3jax.ScoringConfig(lambda1=lambda1, max_range=max_range)
        r3jax.view_utility(m, grid, camera, pose, config)
    assert r3jax.view_utility.__wrapped__._cache_size() - before <= 1


def test_nothing_is_nan_inside(m, grid, camera, frame):
    with jax.debug_nans(True):
        config = r3jax.ScoringConfig(lambda1=2.0)
        u = r3jax.view_utility(m, grid, camera, frame.T_world_camera, config)
        p = r3jax.panorama(m, grid, camera, frame.position, config)
        t = r3jax.voxel_renderability(m, frame.position, focal=camera.focal)
    assert np.isfinite([float(u.total), float(p.best_score), float(t.value.max())]).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"kappa": "two"}, "kappa"),
        ({"delta": "other"}, "delta"),
        ({"panorama_size": 100}, "power of two"),
    ],
)
def test_settings_that_no_formula_knows_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        r3jax.ScoringConfig(**settings)


def test_every_public_name_is_there():
    assert all(getattr(r3jax, name) is not None for name in r3jax.__all__)
    assert "voxel_renderability" in r3jax.__all__
