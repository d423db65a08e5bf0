"""Every backend says what the reference says, however it is asked: one by one or many at once."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import r3jax
from r3jax.kernels.calls import Cells
from r3jax.kernels.native import platform
from r3jax.kernels.visibility.bricks import MAX_VIEWS
from r3jax.mapping.occupancy import OccupancyGrid, cells_of
from r3jax.mapping.state import MapState
from r3jax.planning.candidates import poses_along
from r3jax.scoring import backend, formulas
from r3jax.scoring.config import scoring_config_of
from r3jax.scoring.simulated import simulate_view_near
from r3jax.visibility.views import View, panorama_view, pinhole_view

CAPACITY = 1 << 12
CAMERA = r3jax.Camera(50, 38, 41.0, 39.0, 26.0, 18.5)  # nothing symmetric, no power of two
CONFIG = r3jax.ScoringConfig(max_range=2.5, zbuffer_size=48, panorama_size=64, panorama_bins=90)
NUM = MAX_VIEWS + 2  # mapped, they share an index; in a loop, each goes without
NUM_BINS = {"pinhole": 1, "panorama": CONFIG.panorama_bins}


@functools.cache
def world(seed: int) -> tuple[MapState, OccupancyGrid]:
    """A few leaning walls and lone voxels, seen twice, and a grid of which a third is known."""
    rng = np.random.default_rng(seed)
    m = r3jax.empty_map(CAPACITY, 0.1)
    for _ in range(3):
        middle, u, v = rng.uniform(-1.5, 1.5, 3), *rng.normal(size=(2, 3))
        spread = rng.uniform(-1.0, 1.0, (600, 2))
        wall = middle + spread @ np.stack([u / np.linalg.norm(u), v / np.linalg.norm(v)])
        points = np.concatenate([wall, rng.uniform(-2.0, 2.0, (50, 3))]).astype(np.float32)
        for _ in range(2):
            rgb = rng.random(points.shape).astype(np.float32)
            m = r3jax.integrate_points(m, points, rgb, rng.uniform(-2.0, 2.0, 3), 40.0)
    log_odds = rng.choice([-3.0, 0.0, 3.0], (12, 11, 9))
    corner = jnp.full(3, -1.1, dtype=jnp.float32)
    grid = OccupancyGrid(jnp.asarray(log_odds, jnp.float32), corner, jnp.asarray(0.2, jnp.float32))
    return m, grid


def poses_of(seed: int) -> jax.Array:
    """Views from among the voxels; the last one is no pose."""
    rng = np.random.default_rng([seed, 1])
    poses = poses_along(rng.uniform(-1.0, 1.0, (NUM, 3)), rng.normal(size=(NUM, 3)))
    return jnp.asarray(poses, jnp.float32)


def view_at(kind: str, pose: jax.Array) -> View:
    if kind == "pinhole":
        return pinhole_view(CAMERA, pose, CONFIG)
    return panorama_view(pose[:3, 3], CONFIG)


def asked_of(module, kind: str, config: r3jax.ScoringConfig = CONFIG):
    """`sums_in_view` of `backend` or `formulas`, as a function of what is known and of a pose."""

    def ask(voxels: MapState, cells: Cells, pose: jax.Array):
        view, position = view_at(kind, pose), pose[:3, 3]
        focal, bins = CAMERA.focal, NUM_BINS[kind]
        return module.sums_in_view(voxels, cells, view, position, focal, config, bins)

    return ask


@functools.cache
def programs(kind: str):
    """The reference one by one; the chosen backend one by one, mapped, and in a loop."""
    ask, exact = asked_of(backend, kind), asked_of(formulas, kind)
    loop = lambda v, c, poses: jax.lax.map(lambda pose: ask(v, c, pose), poses)
    return (
        jax.jit(lambda v, c, poses: jax.lax.map(lambda pose: exact(v, c, pose), poses)),
        jax.jit(jax.vmap(ask, (None, None, 0))),
        jax.jit(loop),
    )


def assert_same(found, expected) -> None:
    """Sums of 1 - R to 1e-4 of the largest, numbers of cells exactly."""
    scale = max(1.0, float(jnp.max(expected[0])))
    np.testing.assert_allclose(found[0], expected[0], atol=1e-4 * scale)
    np.testing.assert_array_equal(found[1], expected[1])


@settings(max_examples=8)
@given(st.integers(0, 1000))
@pytest.mark.parametrize("kind", NUM_BINS)
def test_sums_are_those_of_the_reference(kind, seed):
    state, grid = world(seed)
    exact, mapped, looped = programs(kind)
    arguments = state, cells_of(grid), poses_of(seed)
    expected = exact(*arguments)
    assert float(expected[0].sum()) > 1.0
    assert_same(mapped(*arguments), expected)
    assert_same(looped(*arguments), expected)


@pytest.fixture
def no_kernels(monkeypatch):
    """As on a machine where machine code cannot be called, with batches smaller than the views."""
    monkeypatch.setattr(platform, "can_call_kernels", lambda: False)
    monkeypatch.setattr(platform, "MOST_PAIRS", 4 * CAPACITY)


@pytest.mark.parametrize("kind", NUM_BINS)
def test_batches_of_formulas_are_those_of_one_by_one(kind, no_kernels):
    state, grid = world(0)
    arguments = state, cells_of(grid), poses_of(0)
    mapped = jax.jit(jax.vmap(asked_of(backend, kind), (None, None, 0)))
    assert "custom_call" not in mapped.lower(*arguments).as_text()
    assert_same(mapped(*arguments), programs(kind)[0](*arguments))


@pytest.mark.parametrize("kind", NUM_BINS)
def test_gradients_are_those_of_the_reference(kind):
    state, grid = world(0)
    cells, pose = cells_of(grid), poses_of(0)[0]

    def gradient(module):
        total = lambda pose: jnp.sum(asked_of(module, kind)(state, cells, pose)[0])
        return jax.jit(jax.grad(total))(pose)

    found, expected = gradient(backend), gradient(formulas)
    assert np.abs(np.asarray(expected[:3, 3])).max() > 0.1
    np.testing.assert_allclose(found, expected, atol=1e-3)


def test_maps_that_differ_are_scored_each_by_itself():
    """`vmap` over maps and over views of each: the one as a loop, the other as one call."""
    states, grids = zip(*(world(seed) for seed in (0, 1)), strict=True)
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *states)
    cells, poses = cells_of(grids[0]), poses_of(3)
    ask = jax.vmap(asked_of(backend, "pinhole"), (None, None, 0))
    found = jax.jit(jax.vmap(ask, (0, None, None)))(stacked, cells, poses)
    for i, state in enumerate(states):
        expected = programs("pinhole")[0](state, cells, poses)
        assert_same(jax.tree.map(lambda x, i=i: x[i], found), expected)


@pytest.mark.parametrize("kind", NUM_BINS)
def test_views_that_are_none_see_nothing_and_disturb_no_other(kind):
    state, grid = world(0)
    poses = poses_of(0)
    broken = poses.at[1].set(jnp.nan).at[2, 0, 3].set(jnp.inf).at[3, :3, 3].set(1e30)
    found = programs(kind)[1](state, cells_of(grid), broken)
    expected = programs(kind)[1](state, cells_of(grid), poses)
    for sums, sound in zip(found, expected, strict=True):
        assert not np.asarray(sums)[1:4].any()
        np.testing.assert_array_equal(sums[4:], sound[4:])


@functools.cache
def renderabilities():
    """The reference, one by one; the public verb mapped, and its image in a loop."""

    def exact(m: MapState, pose: jax.Array):
        view, position = pinhole_view(CAMERA, pose, CONFIG), pose[:3, 3]
        return formulas.mean_in_pixels(m, view, position, CAMERA.focal, CONFIG.score)

    mean = lambda m, pose: r3jax.renderability(m, CAMERA, pose, CONFIG)
    image = lambda m, pose: r3jax.renderability_image(m, CAMERA, pose, CONFIG)
    return (
        jax.jit(lambda m, poses: jax.lax.map(lambda pose: exact(m, pose), poses)),
        jax.jit(lambda m, poses: jax.vmap(lambda pose: mean(m, pose))(poses)),
        jax.jit(lambda m, poses: jax.lax.map(lambda pose: image(m, pose), poses)),
        jax.jit(jax.vmap(jax.grad(exact, argnums=1), (None, 0))),
        jax.jit(jax.vmap(jax.grad(mean, argnums=1), (None, 0))),
    )


@settings(max_examples=8)
@given(st.integers(0, 1000))
def test_renderability_is_that_of_the_reference(seed):
    state, poses = world(seed)[0], poses_of(seed)
    exact, mapped, images, by_pose, mapped_by_pose = renderabilities()
    expected = exact(state, poses)
    assert float(expected.max()) > 0.01
    np.testing.assert_allclose(mapped(state, poses), expected, atol=1e-4)
    np.testing.assert_allclose(images(state, poses).mean(axis=(1, 2)), expected, atol=1e-4)
    slope, found = by_pose(state, poses), mapped_by_pose(state, poses)
    np.testing.assert_allclose(found[:, :3, 3], slope[:, :3, 3], atol=1e-3)


def test_other_structs_of_xla_are_served_by_plain_jax(monkeypatch):
    monkeypatch.setattr(platform, "misread", lambda: "XLA_FFI_Buffer.data lies at 32, not at 24")
    platform.warn_once.cache_clear()
    state, grid = world(0)
    with pytest.warns(RuntimeWarning, match=r"XLA_FFI_Buffer\.data lies at 32"):
        found = jax.jit(asked_of(backend, "pinhole"))(state, cells_of(grid), poses_of(0)[0])
    expected = programs("pinhole")[0](state, cells_of(grid), poses_of(0)[:1])
    assert_same(found, jax.tree.map(lambda x: x[0], expected))


@pytest.mark.parametrize(
    ("place", "focal"),
    [((np.nan, 0.0, 0.0), 100.0), ((0.0, np.inf, 0.0), 100.0), ((0.0, 0.0, 0.0), 0.0),
     ((0.0, 0.0, 0.0), np.nan)],
)  # fmt: skip
def test_a_question_without_an_answer_has_none_in_any_row(place, focal):
    state = world(0)[0]
    ask = jax.jit(r3jax.voxel_renderability)
    for name, term in vars(ask(state, jnp.array(place), jnp.float32(focal))).items():
        assert np.isnan(term).all(), name
    assert np.isfinite(ask(state, jnp.zeros(3), jnp.float32(100.0)).kappa).all()


@functools.cache
def changes():
    """What imagined views change: by the formulas, one by one; mapped."""
    bins = CONFIG.panorama_bins

    def ask(module, known, kept, position):
        return module(*known, kept, position, CAMERA.focal, CONFIG, bins)

    def by_formulas(before, after, kept, position, focal, config, bins):
        return formulas.change_of_sums(before, after, kept, position, focal, config.score, bins)

    exact = lambda known, kept, at: jax.lax.map(lambda x: ask(by_formulas, known, *x), (kept, at))
    chosen = functools.partial(ask, backend.change_of_sums)
    return jax.jit(exact), jax.jit(jax.vmap(chosen, (None, 0, 0)))


def known_after(seed: int):
    """A world before and after three imagined views, and bits of what positions see of it."""
    state, grid = world(seed)
    before = after = (state, cells_of(grid))
    for pose in poses_of(seed)[:3]:
        after = simulate_view_near(*after, CAMERA, pose, CONFIG)
    rng = np.random.default_rng([seed, 2])
    sizes = [-(-num // 8) for num in (state.capacity, before[1].x.shape[0])]
    kept = tuple(jnp.asarray(rng.integers(0, 256, (NUM, size)), jnp.uint8) for size in sizes)
    return (before, after), kept


@settings(max_examples=8)
@given(st.integers(0, 1000))
def test_changes_are_those_of_the_reference(seed):
    known, kept = known_after(seed)
    exact, mapped = changes()
    expected = exact(known, kept, poses_of(seed)[:, :3, 3])
    change, explored = mapped(known, kept, poses_of(seed)[:, :3, 3])
    np.testing.assert_allclose(change, expected[0], atol=1e-4)
    np.testing.assert_array_equal(explored, expected[1])


def test_imagined_views_change_sums_for_the_better():
    """Or the law above would compare nothing with nothing."""
    known, kept = known_after(0)
    change, explored = changes()[0](known, kept, poses_of(0)[:, :3, 3])
    assert float(change.max()) <= 1e-6  # no renderability ever falls
    assert float(change.sum()) < -1.0
    assert float(explored.sum()) > 1.0


def test_a_setting_that_has_left_the_package_is_refused_by_name():
    with pytest.raises(ValueError, match=r"scoring\.sample"):
        scoring_config_of({"sample": 4})
    assert scoring_config_of({"kappa": "one"}).kappa == "one"
