"""Rasterizers beside the readable one: images where no threshold decides a pixel, and gradients."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from r3jax.splatting.backend import RasterConfig
from r3jax.splatting.backends import numba, reference, xla
from tests.splatting.clouds import random_cloud, safe_pixels

COUNT, SIZE, BUDGET = 120, (50, 38), 1 << 12
CONFIG = RasterConfig(max_intersections=BUDGET, tiles_per_batch=4, gaussians_per_chunk=16)
BACKENDS = {"numba": numba.rasterize, "xla": xla.rasterize}


def composite(rasterize, scene, camera, pose, offsets=None, config=CONFIG):
    offsets = jnp.zeros((scene.capacity, 2)) if offsets is None else offsets
    return rasterize(scene, camera, pose, offsets, config)


def weighted_sum(weights, *arguments):
    """A loss with another weight for every pixel of every image."""
    result = composite(*arguments)
    images = result.rgb, result.depth_sum, result.alpha
    return sum(jnp.sum(image * weight) for image, weight in zip(images, weights, strict=True))


render_with = eqx.filter_jit(composite)


@eqx.filter_jit
def gradients_with(weights, rasterize, variables, config=CONFIG):
    """By the scene, the camera, the pose and, where they are given, the offsets."""

    def loss(variables):
        scene, camera, pose, *offsets = variables
        return weighted_sum(weights, rasterize, scene, camera, pose, *(offsets or [None]), config)

    return jax.grad(loss)(variables)


def random_weights(seed: int, safe: np.ndarray) -> tuple[jax.Array, ...]:
    """Weights of the pixels that no threshold decides; 0 elsewhere."""
    rng = np.random.default_rng(seed)
    height, width = safe.shape
    return tuple(
        jnp.asarray(rng.standard_normal((height, width, *more)) * mask, dtype=jnp.float32)
        for more, mask in (((3,), safe[..., None]), ((), safe), ((), safe))
    )


ALL = random_weights(0, np.ones(SIZE[::-1], dtype=bool))


def solid(seed: int):
    """Opacities near 1, many layers deep: alpha is cut off at 0.99, pixels end at T = 1e-4."""
    scene = random_cloud(seed, COUNT)
    logits, scales = jnp.abs(scene.opacity_logits) * 3.0, scene.log_scales + 0.7
    return dataclasses.replace(scene, opacity_logits=logits, log_scales=scales)


def assert_images_agree(rasterize, scene, camera, pose):
    """On the safe pixels to 1e-4; returns these, and what was found."""
    safe = safe_pixels(scene, camera, pose)
    found = render_with(rasterize, scene, camera, pose)
    expected = render_with(reference.rasterize, scene, camera, pose)
    assert int(found.overflow) == 0
    for name, size in (("rgb", 1.0), ("alpha", 1.0), ("depth_sum", 3.0)):
        difference = np.abs(np.asarray(getattr(found, name) - getattr(expected, name)))
        assert difference[safe].max(initial=0.0) < 1e-4 * size, name
    return safe, found


def assert_agrees(rasterize, seed, scene, camera, pose):
    """Also all gradients to 1e-3: by the pose, the intrinsics and the projected centers, too."""
    safe, found = assert_images_agree(rasterize, scene, camera, pose)
    assert safe.mean() > 0.6
    weights = random_weights(seed, safe)
    variables = (scene, camera, pose, jnp.zeros((scene.capacity, 2)))
    ours = gradients_with(weights, rasterize, variables)
    expected = gradients_with(weights, reference.rasterize, variables)
    paths = jax.tree_util.tree_leaves_with_path(expected)
    for (path, by), mine in zip(paths, jax.tree.leaves(ours), strict=True):
        off, whole = np.linalg.norm(mine - by), np.linalg.norm(by)
        assert off <= 1e-3 * whole + 1e-6, (jax.tree_util.keystr(path), off, whole)
    return found
