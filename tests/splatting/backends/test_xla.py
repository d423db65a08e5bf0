"""The pure-JAX rasterizer alone: batches, `vmap` and `scan`, memory, and how often it compiles."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.geometry.cameras import Camera, look_at
from r3jax.splatting.backend import RasterConfig
from r3jax.splatting.backends import xla
from tests.splatting.backends.agreement import (
    ALL,
    CONFIG,
    COUNT,
    SIZE,
    composite,
    gradients_with,
    render_with,
    solid,
)
from tests.splatting.clouds import random_cloud, view


@pytest.mark.full
@pytest.mark.parametrize(
    ("batch", "chunk"),
    [
        (3, 7),
        pytest.param(1, 32, marks=pytest.mark.slow),
        pytest.param(64, 64, marks=pytest.mark.slow),
    ],
)
def test_sizes_of_batches_and_chunks_do_not_matter(batch, chunk):
    scene, (camera, pose) = solid(3), view(*SIZE)
    config = dataclasses.replace(CONFIG, tiles_per_batch=batch, gaussians_per_chunk=chunk)
    other = partial(_configured, config)
    one, two = (render_with(r, scene, camera, pose) for r in (xla.rasterize, other))
    np.testing.assert_allclose(one.rgb, two.rgb, atol=1e-4)
    by_one, by_two = (gradients_with(ALL, r, (scene, camera, pose)) for r in (xla.rasterize, other))
    for a, b in zip(jax.tree.leaves(by_one), jax.tree.leaves(by_two), strict=True):
        assert np.linalg.norm(a - b) <= 1e-3 * np.linalg.norm(a) + 1e-6


def _configured(config, scene, camera, pose, offsets, _):
    return xla.rasterize(scene, camera, pose, offsets, config)


def test_sizes_below_one_are_refused():
    config = RasterConfig(gaussians_per_chunk=0)
    with pytest.raises(ValueError, match=r"gaussians_per_chunk.*0"):
        composite(xla.rasterize, random_cloud(1, 2), *view(*SIZE), config=config)


@pytest.mark.full
def test_vmap_and_scan_equal_one_view_after_the_other():
    scene, (camera, _) = random_cloud(6, COUNT), view(*SIZE)
    eyes = np.array([[2.0, -0.7, 0.5], [-1.5, 1.0, 0.3], [0.2, 1.8, 0.9]])
    poses = jnp.stack([look_at(eye, np.zeros(3)) for eye in eyes])

    def loss(scene, pose):
        result = composite(xla.rasterize, scene, camera, pose)
        return jnp.sum(result.rgb * ALL[0]) + jnp.sum(result.depth_sum), result.overflow

    step = jax.value_and_grad(loss, argnums=(0, 1), has_aux=True)
    single = jax.jit(step)
    expected = jax.tree.map(lambda *x: jnp.stack(x), *[single(scene, pose) for pose in poses])
    mapped = jax.jit(jax.vmap(step, in_axes=(None, 0)))(scene, poses)
    scanned = jax.jit(lambda p: jax.lax.scan(lambda c, x: (c, step(scene, x)), 0, p)[1])(poses)
    for found in (mapped, scanned):
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4 * np.abs(b).max())


@pytest.mark.full
def test_memory_does_not_grow_with_the_layers():
    """Autodiff through the loop would keep alpha and more for each pair of pixel and Gaussian."""
    count, edge = 20_000, 128
    scene = jax.eval_shape(lambda: random_cloud(0, count))
    camera = Camera.from_fov(edge, edge, 60.0)
    loss = lambda scene: jnp.sum(
        composite(xla.rasterize, scene, camera, jnp.eye(4), config=RasterConfig()).rgb
    )
    compiled = jax.jit(jax.grad(loss)).lower(scene).compile()
    analysis = compiled.memory_analysis()
    assert analysis is not None
    assert analysis.temp_size_in_bytes < 16 << 20


def test_a_growing_scene_compiles_seldom():
    budgets = {
        RasterConfig().with_room(needed).max_intersections
        for needed in range(1000, 1_000_000, 1000)
    }
    assert len(budgets) < 50
