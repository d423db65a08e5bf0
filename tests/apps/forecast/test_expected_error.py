"""The error to expect of a view: its formula, what it may not depend on, and its derivatives."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import r3jax
from r3jax.apps.forecast import expected_error
from r3jax.apps.forecast.expected_error import (
    DISSIMILARITY,
    REACH,
    SQUARED,
    TERMS,
    error_terms,
    expected_of_means,
)
from r3jax.scoring.renderability import term_images

SIDE = 32
CAPACITY = 1 << 12
CAMERA = r3jax.Camera.from_fov(SIDE, SIDE, 60.0)
AHEAD = jnp.array([0.0, 1.0, 0.0])


def pose_at(x: float, y: float = 0.0) -> jax.Array:
    return r3jax.pose_along(jnp.array([x, y, 1.0]), AHEAD)


def frame_of(colors: np.ndarray, x: float = 0.0) -> r3jax.Frame:
    """An image of the wall y = 2; what is left of the middle is not measured."""
    depth = np.full((SIDE, SIDE), 2.0, np.float32)
    depth[:, : SIDE // 4] = 0.0
    return r3jax.Frame(colors.astype(np.float32), depth, pose_at(x), CAMERA)


def wall(contrast: float, places: tuple[float, ...] = (0.0, 0.5)) -> r3jax.MapState:
    """A map of a wall whose texture has that contrast."""
    noise = np.random.default_rng(0).uniform(-1.0, 1.0, (SIDE, SIDE, 3))
    state = r3jax.empty_map(CAPACITY, 0.05)
    for x in places:
        state = r3jax.integrate(state, frame_of(0.5 + contrast * noise, x))
    return state


TEXTURED, PLAIN = wall(0.4), wall(0.0)
VIEW = pose_at(0.3, 0.2)


def expected(T_world_camera: jax.Array) -> jax.Array:
    """PSNR of a view of the textured wall [dB]."""
    return r3jax.expected_error(TEXTURED, CAMERA, T_world_camera).psnr


def test_formula() -> None:
    """Term by term, from the images of R and the difficulties of the rows."""
    config = r3jax.ScoringConfig()
    found = np.asarray(expected_error.error_terms(TEXTURED, CAMERA, VIEW, config))
    images = term_images(TEXTURED, CAMERA, VIEW, config)
    row, R = np.asarray(images.row), np.asarray(images.value, np.float64)
    hit = row < CAPACITY
    assert hit.any()
    assert not hit.all()
    hard = np.asarray(r3jax.voxel_difficulty(TEXTURED), np.float64)
    C = np.where(hit, hard[np.minimum(row, CAPACITY - 1)], 0.0)
    D = np.where(hit, 1.0 - R, 0.0)
    there = np.asarray(TEXTURED.present)
    squares = np.mean(np.asarray(TEXTURED.mean, np.float64)[:, there] ** 2, axis=0)
    L = (squares.sum() + 0.25) / (there.sum() + 1)
    expected = np.stack([np.ones_like(C), np.where(hit, 0.0, L), C, D * D, C * D])
    np.testing.assert_allclose(found, expected, atol=1e-5)
    by_hand = -10.0 * np.log10(np.mean(np.tensordot(SQUARED.coefficients, expected, 1)) + 1e-5)
    told = expected_error.expected_error(TEXTURED, CAMERA, VIEW)
    assert float(told.psnr) == pytest.approx(by_hand, abs=1e-3)
    ssim = 1.0 - np.mean(np.tensordot(DISSIMILARITY.coefficients, expected, 1))
    assert float(told.ssim) == pytest.approx(ssim, abs=1e-4)
    assert float(told.psnr_low) < float(told.psnr) < float(told.psnr_high)
    assert float(told.ssim_low) < float(told.ssim) < float(told.ssim_high)


def test_reach() -> None:
    """What is beyond the sensor's range was seen from nearby, and is no hole."""
    far = expected_error.error_terms(TEXTURED, CAMERA, pose_at(0.0, -8.0))
    assert float(jnp.max(far[TERMS.index("difficulty")])) > 0.0
    beyond = expected_error.error_terms(TEXTURED, CAMERA, pose_at(0.0, -5.0 * REACH))
    assert float(jnp.max(beyond[TERMS.index("difficulty")])) == 0.0


def test_no_coefficient_is_negative_and_the_interval_holds_the_expectation():
    for fit in (SQUARED, DISSIMILARITY):
        assert len(fit.coefficients) == len(TERMS)
        assert min(fit.coefficients) >= 0.0
        assert fit.low < 0.0 < fit.high


def test_the_error_never_falls_with_difficulty_and_never_rises_with_renderability():
    for hard in (0.0, 0.05, 0.3):
        lack = np.linspace(1.0, 0.0, 9)
        terms = np.stack([np.ones(9), np.zeros(9), np.full(9, hard), lack**2, hard * lack], axis=1)
        told = [expected_of_means(jnp.asarray(row, jnp.float32)) for row in terms]
        assert (np.diff([float(one.psnr) for one in told]) >= 0.0).all()
        assert (np.diff([float(one.ssim) for one in told]) >= 0.0).all()
    for lack in (0.0, 0.4, 1.0):
        hard = np.linspace(0.0, 0.5, 9)
        terms = np.stack([np.ones(9), np.zeros(9), hard, np.full(9, lack**2), hard * lack], axis=1)
        told = [expected_of_means(jnp.asarray(row, jnp.float32)) for row in terms]
        assert (np.diff([float(one.psnr) for one in told]) < 0.0).all()
        assert (np.diff([float(one.ssim) for one in told]) <= 0.0).all()


def test_a_plain_wall_is_easier_than_a_textured_one():
    plain, textured = (r3jax.expected_error(m, CAMERA, VIEW) for m in (PLAIN, TEXTURED))
    assert float(plain.psnr) > float(textured.psnr) + 1.0
    assert float(plain.ssim) > float(textured.ssim) + 0.05


def test_looking_from_more_directions_makes_a_view_better():
    once = r3jax.expected_error(wall(0.4, (1.2,)), CAMERA, VIEW)
    everywhere = jnp.full_like(TEXTURED.visited, 0xFFFFFFFF)
    often = r3jax.expected_error(replace(TEXTURED, visited=everywhere), CAMERA, VIEW)
    twice = r3jax.expected_error(TEXTURED, CAMERA, VIEW)
    assert float(once.psnr) < float(twice.psnr) <= float(often.psnr)


def test_a_view_is_the_mean_of_its_images():
    images = r3jax.expected_error_images(TEXTURED, CAMERA, VIEW)
    told = r3jax.expected_error(TEXTURED, CAMERA, VIEW)
    psnr = -10.0 * np.log10(np.mean(np.asarray(images.squared, np.float64)) + 1e-5)
    assert float(told.psnr) == pytest.approx(psnr, abs=1e-3)
    assert float(told.ssim) == pytest.approx(1.0 - float(images.dissimilarity.mean()), abs=1e-5)
    assert images.squared.shape == (SIDE, SIDE)
    assert float(images.squared.min()) >= 0.0


def test_many_views_are_expected_as_one_and_a_known_difficulty_changes_nothing():
    poses = jnp.stack([pose_at(x, y) for x, y in ((0.0, 0.0), (0.2, -0.3), (-0.4, 0.5))])
    hard = r3jax.voxel_difficulty(TEXTURED)
    expect = lambda T: r3jax.expected_error(TEXTURED, CAMERA, T, difficulty=hard).psnr
    single = [float(r3jax.expected_error(TEXTURED, CAMERA, T).psnr) for T in poses]
    np.testing.assert_allclose(jax.jit(jax.vmap(expect))(poses), single, atol=1e-4)


def test_neither_order_nor_merging_changes_an_expectation():
    x, z = np.meshgrid(np.linspace(-1.0, 1.0, 24), np.linspace(0.0, 2.0, 24))
    points = np.stack([x, np.full_like(x, 2.0), z], axis=-1).reshape(-1, 3).astype(np.float32)
    colors = np.random.default_rng(1).random((3, len(points), 3)).astype(np.float32)
    places = np.array([[0.0, 0.0, 1.0], [0.7, 0.3, 1.2], [-0.5, 0.6, 0.8]], np.float32)

    def seen(looks: tuple[int, ...]) -> r3jax.MapState:
        state = r3jax.empty_map(CAPACITY, 0.05)
        for k in looks:
            state = r3jax.integrate_points(state, points, colors[k], places[k], CAMERA.focal)
        return state

    expect = lambda state: float(r3jax.expected_error(state, CAMERA, VIEW).psnr)
    once = expect(seen((0, 1, 2)))
    assert expect(seen((2, 0, 1))) == pytest.approx(once, abs=1e-3)
    assert expect(r3jax.merge(seen((1,)), seen((2, 0)))) == pytest.approx(once, abs=1e-3)


def test_the_expectation_differentiates_as_differences_say():
    step, axis = 2e-3, jnp.array([1.0, 0.0, 0.0])
    moved = lambda by: VIEW.at[:3, 3].add(by * axis)
    slope = float(jax.jit(jax.grad(lambda by: expected(moved(by))))(0.0))
    hard = np.asarray(r3jax.voxel_difficulty(TEXTURED), np.float64)
    terms = np.asarray(error_terms(TEXTURED, CAMERA, VIEW), np.float64)
    # Which voxel a pixel sees is held fixed: a difference means the same only if it is, too.
    row = np.asarray(term_images(TEXTURED, CAMERA, VIEW).row).reshape(-1)
    hit, row = row < CAPACITY, np.minimum(row, CAPACITY - 1)

    def by_hand(by: float) -> float:
        R = r3jax.voxel_renderability(TEXTURED, moved(by)[:3, 3], CAMERA.focal).value
        D = np.where(hit, 1.0 - np.asarray(R, np.float64)[row], 0.0)
        known, both = terms[:3].mean(axis=(1, 2)), np.mean(np.where(hit, hard[row] * D, 0.0))
        means = [*known, np.mean(D * D), both]
        return -10.0 * np.log10(np.dot(SQUARED.coefficients, means) + 1e-5)

    assert by_hand(0.0) == pytest.approx(float(expected(VIEW)), abs=1e-3)
    assert abs(slope) > 1e-3
    difference = (by_hand(step) - by_hand(-step)) / (2.0 * step)
    assert slope == pytest.approx(difference, rel=0.05, abs=5e-3)


def test_an_empty_map_expects_holes_and_a_pose_that_is_not_rigid_nothing():
    empty = r3jax.empty_map(CAPACITY, 0.05)
    told = r3jax.expected_error(empty, CAMERA, VIEW)
    assert float(told.psnr) < float(r3jax.expected_error(TEXTURED, CAMERA, VIEW).psnr)
    assert np.isfinite(float(told.psnr))
    bent = jax.jit(lambda T: r3jax.expected_error(TEXTURED, CAMERA, T).psnr)(2.0 * VIEW)
    assert np.isnan(float(bent))
    with pytest.raises(ValueError, match="rigid"):
        r3jax.expected_error(TEXTURED, CAMERA, 2.0 * VIEW)


def test_the_terms_have_their_names():
    assert error_terms(TEXTURED, CAMERA, VIEW).shape == (len(TERMS), SIDE, SIDE)
