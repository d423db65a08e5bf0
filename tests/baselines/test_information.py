"""Sums over (pixel, Gaussian) pairs against dense differentiation of every pixel."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r3jax.baselines import information
from r3jax.baselines.information import pixel_squares, pixel_tallies, with_room
from r3jax.geometry.cameras import Camera
from r3jax.splatting import projection
from r3jax.splatting.backend import RasterConfig
from r3jax.splatting.render import render
from tests.splatting.clouds import random_cloud, safe_pixels, view

BEHIND = jnp.array([0.2, 0.5, 0.1])
COUNT, BUDGET = 50, RasterConfig(max_intersections=1 << 12)


def dense_squares(scene, camera, pose):
    """Every pixel's channel sum differentiated by every parameter at once, squared, summed."""

    def channel_sums(scene):
        config = RasterConfig(backend="reference")
        return render(scene, camera, pose, BEHIND, config).rgb.sum(axis=-1)

    jacobian = jax.jacfwd(channel_sums)(scene)
    return jax.tree.map(lambda g: jnp.sum(g * g, axis=(0, 1)), jacobian)


def assert_same(found, expected, tolerance=1e-4):
    """Every number relative to itself, those far below the largest of their kind to that."""
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        a, b = np.asarray(getattr(found, name)), np.asarray(getattr(expected, name))
        assert b.max() > 0.0
        assert np.all(np.abs(a - b) <= tolerance * np.abs(b) + 1e-6 * b.max()), name


def test_squares_are_those_of_the_dense_jacobian(monkeypatch):
    # Forward mode cannot pass a gradient that is written out.
    monkeypatch.setattr(projection, "_sum_harmonics", projection._sum_harmonics.fun)
    scene = random_cloud(3, COUNT, 1)
    camera, pose = view(16, 16)
    assert safe_pixels(scene, camera, pose).all()
    expected = dense_squares(scene, camera, pose)
    for source in ("numba", "reference"):
        found, overflow = pixel_squares(scene, camera, pose, BEHIND, BUDGET, source)
        assert int(overflow) == 0
        assert_same(found, expected)


_squares = jax.jit(pixel_squares, static_argnames="source")


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 1 << 20))
def test_both_sources_agree_on_any_cloud(seed):
    scene = random_cloud(seed, COUNT, 1)
    camera, pose = view(21, 18)
    if not safe_pixels(scene, camera, pose).all():
        return  # float32 may decide either way
    found, expected = (
        _squares(scene, camera, pose, BEHIND, BUDGET, source)[0]
        for source in ("numba", "reference")
    )
    assert_same(found, expected, 1e-3)


@jax.jit
def _of_one_pixel(scene, camera, pose):
    def color(scene):
        return render(scene, camera, pose, BEHIND, BUDGET).rgb.sum()

    return jax.grad(color)(scene), pixel_squares(scene, camera, pose, BEHIND, BUDGET)[0]


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 1 << 20))
def test_the_squares_of_one_pixel_are_its_squared_gradient(seed):
    """The backward pass adds up over pixels: where there is one, squaring afterwards will do."""
    _, pose = view(16, 16)
    camera = Camera(1, 1, 12.0, 12.0, 0.4, 0.6)
    gradient, squares = _of_one_pixel(random_cloud(seed, COUNT, 3), camera, pose)
    for by, square in zip(jax.tree.leaves(gradient), jax.tree.leaves(squares), strict=True):
        by, square = np.asarray(by, np.float64) ** 2, np.asarray(square)
        # Terms cancel in some components: to the Gaussian's largest, then.
        np.testing.assert_allclose(square, by, rtol=1e-3, atol=1e-5 * max(by.max(), 1e-30))


@pytest.mark.parametrize("least", [(0.0, 0.0), (0.5, 0.0), (0.0, 0.03)])
def test_tallies_are_sums_of_single_weights(least):
    """By hand: weights in NumPy, pixel by pixel, from the alphas of single Gaussians."""
    scene, (camera, pose) = random_cloud(5, 12, 0), view(16, 16)
    rng = np.random.default_rng(1)
    value, counts = (jnp.asarray(rng.random((16, 16)), jnp.float32) for _ in range(2))
    found, expected = (
        pixel_tallies(
            scene, camera, pose, value, counts, BUDGET,
            least_through=least[0], least_weight=least[1], source=source,
        )[0]
        for source in ("numba", "reference")
    )  # fmt: skip
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)
    if least == (0.0, 0.0):
        # A Gaussian alone is the image's alpha; among others, its share of it.
        alone = [float(jnp.sum(value * _alone(scene, i, camera, pose))) for i in range(12)]
        assert np.all(np.asarray(found)[:, 0] <= np.asarray(alone) + 1e-4)
        alpha = render(scene, camera, pose).alpha
        np.testing.assert_allclose(found[:, 0].sum(), jnp.sum(value * alpha), rtol=1e-4)


def _alone(scene, i, camera, pose):
    faint = jnp.where(jnp.arange(scene.capacity) == i, scene.opacity_logits, -100.0)
    return render(dataclasses.replace(scene, opacity_logits=faint), camera, pose).alpha


def test_a_view_that_overflows_is_asked_for_again(monkeypatch):
    asked = []

    def squares(config, scene, camera, pose):
        asked.append(config.max_intersections)
        result, overflow = pixel_squares(scene, camera, pose, BEHIND, config)
        return result, overflow

    monkeypatch.setattr(
        information.RasterConfig, "budget", lambda self, n: self.max_intersections or 64
    )
    scene, (camera, pose) = random_cloud(3, COUNT, 1), view(64, 64)
    found = with_room(squares, scene, camera, pose)
    assert asked[0] is None
    assert len(asked) > 1
    assert float(found.means.max()) > 0.0
