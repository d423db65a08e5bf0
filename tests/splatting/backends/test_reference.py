"""The readable rasterizer against closed forms and a plain float64 loop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.splatting.backend import RasterConfig
from r3jax.splatting.backends import reference
from r3jax.splatting.projection import ProjectedGaussians, project_gaussians
from tests.splatting.clouds import random_cloud, view

COUNT = 120
CONFIG = RasterConfig(backend="reference")


def in_front_of(pixel: tuple[float, float], opacities, colors, depths) -> ProjectedGaussians:
    """Round Gaussians of one pixel's width exactly at a pixel's center."""
    count = len(opacities)
    ones = jnp.ones(count)
    return ProjectedGaussians(
        center=jnp.stack([ones * pixel[0], ones * pixel[1]]),
        conic=jnp.stack([ones, 0.0 * ones, ones]),
        depth=jnp.asarray(depths, dtype=jnp.float32),
        opacity=jnp.asarray(opacities, dtype=jnp.float32),
        color=jnp.asarray(colors, dtype=jnp.float32).T,
        reach=jnp.full((2, count), 4.0),
    )


def composite(*gaussians) -> tuple[np.ndarray, float, float]:
    projected = in_front_of((3.5, 2.5), *gaussians)
    rgb, depth, alpha = reference.composite_pixel(projected, jnp.asarray(3.5), jnp.asarray(2.5))
    return np.asarray(rgb), float(depth), float(alpha)


def test_two_layers() -> None:
    """w1 = a1, w2 = (1 - a1) a2."""
    rgb, depth, alpha = composite([0.5, 0.4], [[1, 0, 0], [0, 2, 0]], [1.0, 3.0])
    np.testing.assert_allclose(rgb, [0.5, 0.4, 0.0], atol=1e-6)
    np.testing.assert_allclose([depth, alpha], [0.5 + 0.2 * 3.0, 0.7], atol=1e-6)


def test_limits() -> None:
    """Alpha is at most 0.99; below 1/255 it is skipped."""
    assert composite([1.0], [[1, 1, 1]], [1.0])[2] == pytest.approx(0.99, abs=1e-6)
    assert composite([0.9 / 255], [[1, 1, 1]], [1.0])[2] == 0.0
    assert composite([1.1 / 255], [[1, 1, 1]], [1.0])[2] > 0.0


def test_stops() -> None:
    """Two layers of 0.99 leave T = 1e-4; the next would fall below and is not drawn."""
    colors = [[1, 0, 0], [0, 1, 0], [0, 0, 100]]
    rgb, _, alpha = composite([0.98, 0.98, 0.9], colors, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(rgb, [0.98, 0.02 * 0.98, 0.0], atol=1e-6)
    assert alpha == pytest.approx(1.0 - 4e-4, abs=1e-6)


def test_equals_loop() -> None:
    """The whole image equals a loop over pixels and Gaussians in float64."""
    scene, (camera, pose) = random_cloud(5, COUNT), view(24, 18)
    zeros = jnp.zeros((COUNT, 2))
    found = jax.jit(reference.rasterize)(scene, camera, pose, zeros, CONFIG)
    projected = project_gaussians(scene, camera, pose, zeros)
    expected = np.zeros((18, 24, 5))
    safe = np.ones((18, 24), dtype=bool)
    p = jax.tree.map(lambda x: np.asarray(x, dtype=np.float64), projected)
    order = [i for i in np.argsort(p.depth) if p.reach[0, i] >= 0]
    for row, column in np.ndindex(18, 24):
        through = 1.0
        for i in order:
            dx, dy = p.center[0, i] - column - 0.5, p.center[1, i] - row - 0.5
            s = 0.5 * (p.conic[0, i] * dx**2 + p.conic[2, i] * dy**2) + p.conic[1, i] * dx * dy
            alpha = min(0.99, p.opacity[i] * np.exp(-s))
            safe[row, column] &= abs(alpha * 255 - 1) > 1e-3
            if alpha < 1 / 255:
                continue
            safe[row, column] &= abs(through * (1 - alpha) - 1e-4) > 1e-6
            if through * (1 - alpha) <= 1e-4:
                break
            expected[row, column] += through * alpha * np.append(p.color[:, i], [p.depth[i], 1.0])
            through *= 1 - alpha
    assert safe.mean() > 0.8
    images = np.concatenate([found.rgb, found.depth_sum[..., None], found.alpha[..., None]], -1)
    np.testing.assert_allclose(images[safe], expected[safe], atol=2e-5)


@given(seed=st.integers(0, 1000))
def test_order_of_rows_does_not_matter(seed):
    scene, (camera, pose) = random_cloud(6, COUNT), view(24, 18)
    shuffled = np.random.default_rng(seed).permutation(COUNT)
    mixed = jax.tree.map(lambda x: x[shuffled], scene)
    zeros = jnp.zeros((COUNT, 2))
    one = rasterize(scene, camera, pose, zeros, CONFIG)
    other = rasterize(mixed, camera, pose, zeros, CONFIG)
    np.testing.assert_allclose(other.rgb, one.rgb, atol=1e-5)
    assert float(one.alpha.max()) < 1.0


rasterize = jax.jit(reference.rasterize)
