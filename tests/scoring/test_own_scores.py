"""R of one's own: powers, other combinations of the terms, and importance, against float64."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import r3jax
from r3jax.errors import InputError
from r3jax.planning.registry import make_policy
from r3jax.runs.header import policy_fields
from r3jax.scoring.config import Score, scoring_config_of
from r3jax.scoring.renderability import term_images
from r3jax.scoring.terms import deficits, score_voxels
from tests.scoring.test_backends import CAMERA, NUM, poses_of, world
from tests.scoring.test_laws import FOCAL, POSITION, expected_terms, make_voxels

pytestmark = pytest.mark.filterwarnings("ignore:ScoringConfig has a combination")


def config(**own) -> r3jax.ScoringConfig:
    return r3jax.ScoringConfig(
        max_range=2.5, zbuffer_size=48, panorama_size=64, panorama_bins=90, **own
    )


def product(voxels, terms):
    return terms.bias * terms.noise * terms.resolution


def worst(voxels, terms):
    """The least of the terms, and beyond 1 where the camera is far away, which is clipped."""
    least = jnp.minimum(jnp.minimum(terms.bias, terms.noise), terms.resolution)
    return jnp.where(voxels.center[0] > 1.0, 1.5, least)


def ones(voxels):
    return jnp.ones_like(voxels.count)


def height(voxels):
    """Three times as important above the origin."""
    return jnp.where(voxels.center[2] > 0.0, 3.0, 1.0)


def scores(own: r3jax.ScoringConfig, pose: jax.Array):
    state, grid = world(3)
    return (
        r3jax.renderability(state, CAMERA, pose, own),
        r3jax.view_utility(state, grid, CAMERA, pose, own),
        r3jax.panorama(state, grid, CAMERA, pose[:3, 3], own).bin_scores,
        r3jax.explain_view(state, grid, CAMERA, pose, own).totals,
    )


def found(own: r3jax.ScoringConfig):
    return jax.vmap(lambda pose: scores(own, pose))(poses_of(3)[: NUM - 1])


@pytest.mark.parametrize(
    "own",
    [{"bias_power": 1.0}, {"combine": product}, {"importance": ones},
     {"importance": r3jax.CellImportance(np.ones((2, 2, 2)), np.zeros(3), 0.5)}],
)  # fmt: skip
def test_the_papers_score_written_as_ones_own_is_the_same(own):
    expected = found(config())
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-4, atol=2e-4),
                 found(config(**own)), expected)  # fmt: skip


def test_powers_and_combinations_follow_float64():
    voxels, position = make_voxels(), jnp.asarray(POSITION, jnp.float32)
    at = position, jnp.float32(FOCAL)
    terms = expected_terms(voxels)
    own = config(bias_power=2.0, noise_power=0.0, resolution_power=0.5).score
    value = terms["bias"] ** 2 * terms["resolution"] ** 0.5
    np.testing.assert_allclose(score_voxels(voxels, *at, own).value, value, atol=3e-5)
    least = np.min([terms[name] for name in ("bias", "noise", "resolution")], axis=0)
    x = np.asarray(voxels.center[0])
    least = np.where(np.asarray(voxels.count) > 0, np.where(x > 1.0, 1.0, least), 0.0)
    own = config(combine=worst).score
    np.testing.assert_allclose(score_voxels(voxels, *at, own).value, least, atol=3e-5)
    weight = np.where(np.asarray(voxels.center[2]) > 0.0, 3.0, 1.0)
    own = config(combine=worst, importance=height).score
    np.testing.assert_allclose(deficits(voxels, *at, own), weight * (1.0 - least), atol=1e-4)


def test_importance_weighs_sums_and_means():
    state, grid = world(3)
    for pose in poses_of(3)[:4]:
        image = r3jax.renderability_image(state, CAMERA, pose, config())
        row = np.asarray(term_images(state, CAMERA, pose, config()).row)
        z = np.append(np.asarray(state.center[2]), -1.0)[np.minimum(row, state.capacity)]
        weight = np.where((row < state.capacity) & (z > 0.0), 3.0, 1.0)
        mean = (weight * np.asarray(image, np.float64)).sum() / weight.sum()
        own = config(importance=height)
        np.testing.assert_allclose(r3jax.renderability(state, CAMERA, pose, own), mean, atol=2e-4)
        shares = np.asarray(r3jax.explain_view(state, grid, CAMERA, pose, config()).shares)
        of_rows = np.where(np.asarray(state.center[2]) > 0.0, 3.0, 1.0) * shares.sum(axis=0)
        utility = r3jax.view_utility(state, grid, CAMERA, pose, own)
        np.testing.assert_allclose(utility.rendering, of_rows.sum(), rtol=2e-4, atol=1e-3)


def test_causes_sum_to_the_utility_of_ones_own_score():
    """Also where all terms are 1 and R is not."""
    state, grid = world(3)
    own = config(combine=lambda voxels, terms: 0.5 * product(voxels, terms), importance=height)
    for pose in poses_of(3)[:3]:
        total = r3jax.view_utility(state, grid, CAMERA, pose, own).total
        totals = r3jax.explain_view(state, grid, CAMERA, pose, own).totals
        np.testing.assert_allclose(totals.sum(), total, rtol=2e-4)


def test_an_importance_over_space_is_looked_up_by_position():
    values = np.arange(1.0, 9.0).reshape(2, 2, 2)
    box = r3jax.CellImportance(
        values, origin=np.array([-1.0, -1.0, -1.0]), cell_size=1.0, outside=9
    )
    state, _ = world(1)
    center = np.asarray(state.center, np.float64)
    index = np.floor(center + 1.0).astype(int)
    is_inside = ((index >= 0) & (index < 2)).all(axis=0)
    expected = np.where(is_inside, values[tuple(np.clip(index, 0, 1))], 9.0)
    assert is_inside.any()
    assert not is_inside.all()
    np.testing.assert_array_equal(box(state), expected)


def test_other_powers_compile_nothing():
    state, grid = world(3)
    score = jax.jit(lambda pose, own: r3jax.view_utility(state, grid, CAMERA, pose, own).total)
    pose = poses_of(3)[0]
    values = [float(score(pose, config(bias_power=power))) for power in (1.0, 2.0, 3.0)]
    assert score._cache_size() == 1
    assert values[0] < values[1] < values[2]  # R falls, so more is missing


def test_a_planner_decides_by_ones_own_score():
    own = config(combine=worst, importance=height)
    pose = np.eye(4)
    planner = r3jax.start(
        CAMERA, np.array([[-2.0, -2.0, -1.0], [2.0, 2.0, 1.0]]),
        make_policy("r3-pano", scoring=own, num_candidates=8, num_frontier=0), starts=[pose],
    )  # fmt: skip
    depth = np.full((CAMERA.height, CAMERA.width), 1.5, np.float32)
    rgb = np.random.default_rng(0).random((*depth.shape, 3)).astype(np.float32)
    planner = r3jax.observe(planner, r3jax.Frame.from_arrays(rgb, depth, pose, CAMERA))
    decision, _, _ = r3jax.decide(planner, pose, jax.random.key(0))
    assert np.isfinite(decision.T_world_camera).all()


def test_records_name_functions_and_find_them_again():
    plain = policy_fields(make_policy("r3", scoring=config(combine=worst)))["settings"]["scoring"]
    assert plain["combine"] == f"{__name__}:worst"
    again = scoring_config_of(plain)
    assert again.score.combine.func is worst
    assert "importance" not in plain
    assert "bias_power" not in policy_fields(make_policy("r3"))["settings"]["scoring"]
    for own in (
        {"combine": lambda voxels, terms: terms.bias},
        {"importance": r3jax.CellImportance(np.ones((1, 1, 1)), np.zeros(3), 1.0)},
    ):
        with pytest.raises(InputError, match="combine and importance"):
            policy_fields(make_policy("r3", scoring=config(**own)))


@pytest.mark.parametrize(
    ("own", "named"),
    [({"combine": "nowhere:nothing"}, "nowhere:nothing"), ({"combine": 3}, "combine"),
     ({"importance": "math"}, "math"), ({"bias_power": -1.0}, "bias_power"),
     ({"noise_power": np.nan}, "noise_power")],
)  # fmt: skip
def test_what_is_no_score_is_refused_by_name(own, named):
    with pytest.raises(InputError, match=named):
        r3jax.ScoringConfig(**own)


def test_plain_scores_warn_once_of_their_speed():
    from r3jax.kernels.native.platform import warn_once

    warn_once.cache_clear()
    state, grid = world(3)
    with pytest.warns(RuntimeWarning, match="plain JAX"):
        jax.jit(lambda p: r3jax.view_utility(state, grid, CAMERA, p, config(combine=worst)).total)(
            poses_of(3)[0]
        )
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        r3jax.view_utility(state, grid, CAMERA, poses_of(3)[1], config())
    assert Score().has_kernel
