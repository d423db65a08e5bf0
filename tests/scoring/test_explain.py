"""Shares of a view's utility: laws of the division, a float64 oracle, and U itself."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import r3jax
from r3jax.geometry.cameras import pose_along
from r3jax.mapping.state import MapState
from r3jax.scoring import explain
from r3jax.scoring.explain import CAUSES, explain_view
from r3jax.scoring.utility import visible_unexplored
from tests.exploration.toys import BoxRoom
from tests.scoring.test_laws import FOCAL, NUM, POSITION, expected_terms, make_voxels

NUM_FACTORS, NUM_VOXELS = 3, 8  # one shape: one compile

factor = st.one_of(
    st.sampled_from([0.0, 1e-38, 1e-30, 0.5, 1.0 - 2.0**-24, 1.0]), st.floats(0, 1, width=32)
)
tables = hnp.arrays(np.float32, (NUM_FACTORS, NUM_VOXELS), elements=factor)


def lack_of(factors: np.ndarray) -> np.ndarray:
    return np.float32(1) - factors[0] * factors[1] * factors[2]


_attribute_deficit = jax.jit(explain.attribute_deficit)


def divided(factors: np.ndarray) -> np.ndarray:
    """Shares of every column, in float64."""
    return np.asarray(
        _attribute_deficit(jnp.asarray(lack_of(factors)), jnp.asarray(factors)), np.float64
    )


def by_hand(factors: np.ndarray) -> np.ndarray:
    """The rule, voxel by voxel in float64."""
    shares = np.zeros(factors.shape)
    for i, column in enumerate(factors.astype(np.float64).T):
        lack = 1.0 - column.prod()
        if (column < 1.2e-38).any():
            weight = (column < 1.2e-38).astype(np.float64)
        else:
            weight = -np.log(column)
        if weight.sum() > 0.0:
            shares[:, i] = lack * weight / weight.sum()
    return shares


@given(tables)
def test_shares_are_not_negative_and_sum_to_what_is_lacking(factors):
    shares = divided(factors)
    assert (shares >= 0.0).all()
    np.testing.assert_allclose(shares.sum(axis=0), lack_of(factors), rtol=5e-7, atol=0)


@given(tables, st.permutations(range(NUM_FACTORS)))
def test_the_order_of_the_factors_makes_no_difference(factors, order):
    # The product may round otherwise in another order.
    np.testing.assert_allclose(
        divided(factors[order]), divided(factors)[order], rtol=1e-6, atol=1e-7
    )


@given(tables)
def test_a_factor_of_one_takes_nothing(factors):
    assert (divided(factors)[factors == 1.0] == 0.0).all()


@given(tables)
def test_factors_of_zero_take_all_and_share_alike(factors):
    shares, is_zero = divided(factors), factors == 0.0
    some = is_zero.any(axis=0)
    expected = is_zero / np.maximum(is_zero.sum(axis=0), 1)
    # 1e-38 is beyond float32's normal numbers, where devices differ: a 0 like the others.
    expected = np.where((factors == np.float32(1e-38)).any(axis=0), shares, expected)
    np.testing.assert_allclose(shares[:, some], expected[:, some], rtol=1e-6)


@given(tables, st.integers(0, NUM_FACTORS - 1), st.floats(0, 1, width=32))
def test_a_factor_that_falls_takes_more(factors, which, scale):
    lower = factors.copy()
    lower[which] *= np.float32(scale)
    assert (divided(lower)[which] >= divided(factors)[which] - 1e-6).all()


@given(tables)
def test_the_division_is_that_of_float64(factors):
    # What 1 - R loses to rounding is lost to its shares: 6e-8 of 1.
    # What is hardly above float32's least normal number may be a 0, as above.
    normal = ((factors == 0.0) | (factors > np.float32(2e-38))).all(axis=0)
    found, expected = divided(factors)[:, normal], by_hand(factors)[:, normal]
    np.testing.assert_allclose(found, expected, rtol=2e-6, atol=1.5e-7)


SHIFT = 23
"""Rows that the voxels of the laws are moved on by: the last row then holds one in view."""


def tiny_map() -> MapState:
    """The voxels of the laws of R, as a map; one row is empty."""
    roll = lambda x: jnp.roll(x, SHIFT, axis=-1) if x.ndim else x
    voxels = jax.tree.map(roll, make_voxels())
    return MapState(
        key=voxels.key,
        visited=voxels.visited,
        count=voxels.count,
        mean=jnp.zeros((3, NUM)),
        m2=voxels.m2,
        resolution=voxels.resolution,
        voxel_size=voxels.voxel_size,
        dropped=jnp.zeros((), jnp.int32),
        num_bins=64,
    )


TINY_CAMERA = r3jax.Camera(64, 64, fx=FOCAL, fy=FOCAL, cx=32.0, cy=32.0)
TINY_BOX = np.array([[-1.0, -1.0, -0.4], [1.0, 1.0, 1.2]])


def test_a_tiny_map_is_divided_as_float64_divides_it() -> None:
    """Every voxel that is seen has the shares that float64 gives its terms; no other has any."""
    # Past the middle of the row: its near end lies outside the image.
    direction = jnp.asarray(np.array([0.3, 0.175, 0.15]) - POSITION, jnp.float32)
    pose = pose_along(jnp.asarray(POSITION, jnp.float32), direction)
    config = r3jax.ScoringConfig(lambda1=3.0, zbuffer_size=64)
    grid = r3jax.empty_grid(TINY_BOX)
    found = explain.explain_view(tiny_map(), grid, TINY_CAMERA, pose, config)
    visible = np.asarray(found.visible)
    assert 20 < visible.sum() < NUM - 5
    assert visible[-1]
    assert not visible[SHIFT - 1]  # the empty one
    terms = expected_terms(make_voxels())
    factors = np.stack([terms[name] for name in ("bias", "noise", "resolution")])
    factors = np.roll(factors, SHIFT, axis=1)
    expected = np.where(visible, by_hand(factors), 0.0)
    np.testing.assert_allclose(found.shares, expected, atol=2e-5)
    once = visible & (np.asarray(tiny_map().count) == 1.0)
    assert once.any()
    assert (np.asarray(found.shares)[1, once] == 0.0).all()  # never called inconsistent
    np.testing.assert_allclose(found.totals[1:], expected.sum(axis=1), rtol=2e-5)
    num_cells = int(np.asarray(found.cells).sum())
    assert 0 < num_cells < found.cells.size
    assert float(found.totals[0]) == 3.0 * num_cells


def test_the_division_reaches_every_branch() -> None:
    """All laws above on a table that reaches every branch."""
    factors = np.array(
        [
            [0.5, 1.0, 0.0, 0.0, 1.0, 0.9, 1e-30, 0.25],
            [0.5, 0.2, 0.0, 0.3, 1.0, 1.0, 0.5, 0.5],
            [0.5, 1.0, 0.7, 1.0, 1.0, 0.8, 1.0, 0.125],
        ],
        np.float32,
    )
    shares = explain.attribute_deficit(jnp.asarray(lack_of(factors)), jnp.asarray(factors))
    found = np.asarray(shares, np.float64)
    np.testing.assert_allclose(found, by_hand(factors), rtol=2e-6, atol=1.5e-7)


@pytest.fixture(scope="module")
def known():
    """A map and a grid that have seen two sides of the box room."""
    room, state = BoxRoom(), r3jax.empty_map(1 << 13, 0.1)
    grid = r3jax.empty_grid(room.bounds)
    for direction in ((1.0, 0.3, 0.0), (0.2, 1.0, 0.3)):
        pose = pose_along(jnp.array([1.2, 1.1, 1.3]), jnp.array(direction))
        frame = room.render(np.asarray(pose, np.float64))
        state = r3jax.integrate(state, frame)
        grid = r3jax.integrate_depth(grid, frame)
    return state, grid, room.camera


@pytest.mark.full
@given(st.integers(0, 10_000), st.sampled_from([0.0, 1.0, 16.0]))
def test_the_totals_are_the_utility_of_the_same_view(known, seed, lambda1):
    state, grid, camera = known
    rng = np.random.default_rng(seed)
    position = jnp.asarray(rng.uniform((0.4, 0.4, 0.4), (3.6, 2.6, 2.0)), jnp.float32)
    pose = pose_along(position, jnp.asarray(rng.standard_normal(3), jnp.float32))
    config = r3jax.ScoringConfig(lambda1=lambda1)
    found = explain_view(state, grid, camera, pose, config)
    utility = r3jax.view_utility(state, grid, camera, pose, config)
    exploration, rendering = float(utility.exploration), float(utility.rendering)
    assert len(found.totals) == len(CAUSES)
    assert float(found.totals[0]) == lambda1 * exploration
    assert int(np.asarray(found.cells).sum()) == exploration
    assert float(found.totals[1:].sum()) == pytest.approx(rendering, rel=2e-6)
    assert float(found.totals.sum()) == pytest.approx(float(utility.total), rel=2e-6)
    counted = visible_unexplored(state, grid, camera, pose, config)
    np.testing.assert_array_equal(found.cells, counted)
    # Voxel by voxel: 1 - R where it is seen, nothing elsewhere.
    lack = 1.0 - np.asarray(r3jax.voxel_renderability(state, position, camera.focal).value)
    expected = np.where(found.visible, lack, 0.0)
    np.testing.assert_allclose(np.asarray(found.shares).sum(axis=0), expected, atol=2e-6)


@pytest.mark.full
def test_many_views_are_explained_at_once(known):
    state, grid, camera = known
    directions = jnp.array([[1.0, 0.2, 0.0], [-1.0, 0.1, -0.2], [0.1, 1.0, 0.4]])
    poses = jax.vmap(lambda d: pose_along(jnp.array([1.5, 1.2, 1.2]), d))(directions)
    together = jax.vmap(lambda pose: explain_view(state, grid, camera, pose).totals)(poses)
    single = [explain_view(state, grid, camera, pose).totals for pose in poses]
    np.testing.assert_allclose(together, np.stack(single), rtol=1e-5)


def test_a_map_of_nothing_promises_space_alone(known):
    state, grid, camera = known
    blank = eqx.tree_at(lambda s: s.count, state, jnp.zeros_like(state.count))
    pose = pose_along(jnp.array([1.2, 1.1, 1.3]), jnp.array([-1.0, 0.0, 0.0]))
    found = explain_view(blank, grid, camera, pose)
    assert float(found.totals[0]) > 0.0
    assert (np.asarray(found.totals[1:]) == 0.0).all()
    assert not np.asarray(found.visible).any()


def test_a_sweep_over_settings_and_poses_compiles_once(known):
    state, grid, camera = known
    before = explain_view.__wrapped__._cache_size()
    for lambda1, max_range, x in ((1.0, 5.0, 1.0), (2.0, 3.0, 1.5), (7.5, 4.0, 2.0)):
        config = r3jax.ScoringConfig(lambda1=lambda1, max_range=max_range)
        pose = pose_along(jnp.array([x, 1.1, 1.3]), jnp.array([1.0, 0.0, 0.0]))
        explain_view(state, grid, camera, pose, config)
    assert explain_view.__wrapped__._cache_size() - before <= 1
