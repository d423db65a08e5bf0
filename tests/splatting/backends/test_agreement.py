"""The numba and the pure-JAX rasterizer against the readable one, also on rough input."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.splatting.backends.agreement import (
    ALL,
    BACKENDS,
    CONFIG,
    COUNT,
    SIZE,
    assert_agrees,
    assert_images_agree,
    gradients_with,
    render_with,
    solid,
)
from tests.splatting.clouds import random_cloud, view

pytestmark = pytest.mark.parametrize("rasterize", BACKENDS.values(), ids=BACKENDS)

seeds = st.integers(0, 10_000)


@settings(max_examples=8)
@given(seed=seeds)
def test_images_and_gradients_agree(rasterize, seed):
    assert_agrees(rasterize, seed, random_cloud(seed, COUNT), *view(*SIZE))


@settings(max_examples=6)
@given(seed=seeds)
def test_solid_clouds_agree(rasterize, seed):
    found = assert_agrees(rasterize, seed, solid(seed), *view(*SIZE))
    assert np.mean(np.asarray(found.alpha) > 0.999) > 0.2


@pytest.mark.parametrize("size", [(96, 70), (16, 16), (5, 3), (1, 1), (17, 33)])
def test_sizes_that_are_no_multiple_of_a_tile(rasterize, size):
    assert_images_agree(rasterize, random_cloud(4, COUNT), *view(*size))


def test_gaussians_larger_than_the_image(rasterize):
    """And a camera in the middle of the cloud, where many lie behind or beside it."""
    scene, (camera, pose) = random_cloud(5, COUNT), view(*SIZE, distance=0.3)
    scene = dataclasses.replace(scene, log_scales=scene.log_scales + 2.0)
    found = assert_agrees(rasterize, 5, scene, camera, pose)
    assert int(found.num_intersections) > 400


def test_one_gaussian_and_none_in_sight(rasterize):
    scene, (camera, pose) = random_cloud(1, 1), view(*SIZE)
    centered = dataclasses.replace(scene, means=jnp.zeros((1, 3)), opacity_logits=jnp.ones(1))
    _, found = assert_images_agree(rasterize, centered, camera, pose)
    assert float(found.alpha.max()) > 0.5
    behind = dataclasses.replace(centered, means=2.0 * pose[None, :3, 3])
    result = render_with(rasterize, behind, camera, pose)
    assert float(result.alpha.max()) == float(result.rgb.max()) == 0.0
    assert int(result.num_intersections) == 0
    for leaf in jax.tree.leaves(gradients_with(ALL, rasterize, (behind, camera, pose))):
        assert float(jnp.abs(leaf).max()) == 0.0


@settings(max_examples=15)
@given(seed=seeds, name=st.sampled_from(["means", "quats", "log_scales", "opacity_logits", "sh"]))
def test_what_is_not_a_number_is_not_drawn(rasterize, seed, name):
    """The image is that of the other Gaussians, and all gradients are finite."""
    scene, (camera, pose) = random_cloud(seed, COUNT), view(*SIZE)
    rng = np.random.default_rng(seed)
    values = np.array(getattr(scene, name)).reshape(COUNT, -1)
    broken = rng.choice(COUNT, 10, replace=False)
    values[broken, rng.integers(0, values.shape[1], 10)] = rng.choice([np.nan, -np.nan], 10)
    shape = getattr(scene, name).shape
    spoiled = dataclasses.replace(scene, **{name: jnp.asarray(values.reshape(shape))})
    faded = dataclasses.replace(scene, opacity_logits=scene.opacity_logits.at[broken].set(-50.0))
    found = render_with(rasterize, spoiled, camera, pose)
    expected = render_with(rasterize, faded, camera, pose)
    np.testing.assert_array_equal(found.rgb, expected.rgb)
    for leaf in jax.tree.leaves(gradients_with(ALL, rasterize, (spoiled, camera, pose))):
        assert np.isfinite(leaf).all()


def test_overflow_is_counted(rasterize):
    scene, (camera, pose) = random_cloud(8, COUNT), view(*SIZE)
    needed = int(render_with(rasterize, scene, camera, pose).num_intersections)
    for room, overflow in ((needed, 0), (needed - 5, 5)):
        config = dataclasses.replace(CONFIG, max_intersections=room)
        found = render_with(rasterize, scene, camera, pose, None, config)
        assert (int(found.num_intersections), int(found.overflow)) == (needed, overflow)
