"""The pure-JAX rasterizer against the readable one: images, all gradients, and rough input."""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r3jax.geometry.cameras import Camera, look_at
from r3jax.splatting.backend import RasterConfig
from r3jax.splatting.backends import reference, xla
from tests.splatting.clouds import random_cloud, safe_pixels, view

COUNT, SIZE, BUDGET = 120, (50, 38), 1 << 12
CONFIG = RasterConfig(max_intersections=BUDGET, tiles_per_batch=4, gaussians_per_chunk=16)


def composite(rasterize, scene, camera, pose, offsets=None, config=CONFIG):
    offsets = jnp.zeros((scene.capacity, 2)) if offsets is None else offsets
    return rasterize(scene, camera, pose, offsets, config)


def weighted_sum(weights, *arguments):
    """A loss with another weight for every pixel of every image."""
    result = composite(*arguments)
    images = result.rgb, result.depth_sum, result.alpha
    return sum(jnp.sum(image * weight) for image, weight in zip(images, weights, strict=True))


render_with = eqx.filter_jit(composite)
gradients_with = eqx.filter_jit(
    lambda weights, rasterize, variables: jax.grad(
        lambda variables: weighted_sum(weights, rasterize, *variables)
    )(variables)
)


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


def assert_images_agree(rasterize, scene, camera, pose) -> np.ndarray:
    safe = safe_pixels(scene, camera, pose)
    found = render_with(rasterize, scene, camera, pose)
    expected = render_with(reference.rasterize, scene, camera, pose)
    assert int(found.overflow) == 0
    for name, size in (("rgb", 1.0), ("alpha", 1.0), ("depth_sum", 3.0)):
        difference = np.abs(np.asarray(getattr(found, name) - getattr(expected, name)))
        assert difference[safe].max(initial=0.0) < 1e-4 * size, name
    return safe


def assert_agrees(rasterize, seed, scene, camera, pose) -> None:
    """Images on the safe pixels to 1e-4, the gradients by everything to 1e-3."""
    safe = assert_images_agree(rasterize, scene, camera, pose)
    assert safe.mean() > 0.6
    weights = random_weights(seed, safe)
    variables = (scene, camera, pose, jnp.zeros((scene.capacity, 2)))
    found = gradients_with(weights, rasterize, variables)
    expected = gradients_with(weights, reference.rasterize, variables)
    paths = jax.tree_util.tree_leaves_with_path(expected)
    for (path, by), ours in zip(paths, jax.tree.leaves(found), strict=True):
        off, whole = np.linalg.norm(ours - by), np.linalg.norm(by)
        assert off <= 1e-3 * whole + 1e-6, (jax.tree_util.keystr(path), off, whole)


seeds = st.integers(0, 10_000)


@pytest.mark.full
@settings(max_examples=8)
@given(seeds)
def test_images_and_gradients_agree(seed):
    assert_agrees(xla.rasterize, seed, random_cloud(seed, COUNT), *view(*SIZE))


@pytest.mark.full
@settings(max_examples=6)
@given(seeds)
def test_solid_clouds_agree(seed):
    assert_agrees(xla.rasterize, seed, solid(seed), *view(*SIZE))


@pytest.mark.full
@pytest.mark.parametrize("size", [(1, 1), (17, 33)])
def test_sizes_of_the_image(size):
    assert_images_agree(xla.rasterize, random_cloud(4, COUNT), *view(*size))


@pytest.mark.full
def test_gaussians_larger_than_the_image():
    """And a camera in the middle of the cloud, where many lie behind or beside it."""
    scene, (camera, pose) = random_cloud(5, COUNT), view(*SIZE, distance=0.3)
    scene = dataclasses.replace(scene, log_scales=scene.log_scales + 2.0)
    assert_agrees(xla.rasterize, 5, scene, camera, pose)


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


def test_overflow_is_counted():
    scene, (camera, pose) = random_cloud(8, COUNT), view(*SIZE)
    needed = int(render_with(xla.rasterize, scene, camera, pose).num_intersections)
    tight = dataclasses.replace(CONFIG, max_intersections=needed - 5)
    found = render_with(xla.rasterize, scene, camera, pose, None, tight)
    assert (int(found.num_intersections), int(found.overflow)) == (needed, 5)


@pytest.mark.full
def test_one_gaussian_and_none_in_sight():
    scene, (camera, pose) = random_cloud(1, 1), view(*SIZE)
    centered = dataclasses.replace(scene, means=jnp.zeros((1, 3)), opacity_logits=jnp.ones(1))
    assert_images_agree(xla.rasterize, centered, camera, pose)
    behind = dataclasses.replace(centered, means=2.0 * pose[None, :3, 3])
    result = render_with(xla.rasterize, behind, camera, pose)
    assert float(result.alpha.max()) == float(result.rgb.max()) == 0.0
    assert int(result.num_intersections) == 0
    for leaf in jax.tree.leaves(gradients_with(ALL, xla.rasterize, (behind, camera, pose))):
        assert float(jnp.abs(leaf).max()) == 0.0


@settings(max_examples=10)
@given(seeds, st.sampled_from(["means", "quats", "log_scales", "opacity_logits", "sh"]))
def test_what_is_not_a_number_is_not_drawn(seed, name):
    """The image is that of the other Gaussians, and all gradients are finite."""
    scene, (camera, pose) = random_cloud(seed, COUNT), view(*SIZE)
    rng = np.random.default_rng(seed)
    values = np.array(getattr(scene, name)).reshape(COUNT, -1)
    broken = rng.choice(COUNT, 10, replace=False)
    values[broken, rng.integers(0, values.shape[1], 10)] = np.nan
    shape = getattr(scene, name).shape
    spoiled = dataclasses.replace(scene, **{name: jnp.asarray(values.reshape(shape))})
    faded = dataclasses.replace(scene, opacity_logits=scene.opacity_logits.at[broken].set(-50.0))
    found = render_with(xla.rasterize, spoiled, camera, pose)
    expected = render_with(xla.rasterize, faded, camera, pose)
    np.testing.assert_array_equal(found.rgb, expected.rgb)
    for leaf in jax.tree.leaves(gradients_with(ALL, xla.rasterize, (spoiled, camera, pose))):
        assert np.isfinite(leaf).all()


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
