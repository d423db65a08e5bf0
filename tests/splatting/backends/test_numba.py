"""The numba rasterizer against the readable one: images, all gradients, and rough input."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r3jax.geometry.cameras import Camera
from r3jax.splatting.backend import RasterConfig
from r3jax.splatting.backends import numba, reference
from r3jax.splatting.scene import GaussianScene
from tests.splatting.clouds import random_cloud, safe_pixels, view
from tests.tiers import quick_and_full

COUNT, SIZE, BUDGET = 120, (50, 38), 1 << 12
BACKENDS = {"numba": numba.rasterize, "reference": reference.rasterize}


def composite(backend: str, scene, camera, pose, offsets=None, budget: int = BUDGET):
    offsets = jnp.zeros((scene.capacity, 2)) if offsets is None else offsets
    config = RasterConfig(max_intersections=budget)
    return BACKENDS[backend](scene, camera, pose, offsets, config)


def weighted_sum(weights, *arguments):
    """A loss with another weight for every pixel of every image."""
    result = composite(*arguments)
    images = result.rgb, result.depth_sum, result.alpha
    return sum(jnp.sum(image * weight) for image, weight in zip(images, weights, strict=True))


render_with = eqx.filter_jit(composite)


@eqx.filter_jit
def gradients_with(weights, backend: str, variables, budget: int = BUDGET):
    """By the scene, the camera, the pose and, where they are given, the offsets."""

    def loss(variables):
        scene, camera, pose, *offsets = variables
        zeros = jnp.zeros((scene.capacity, 2))
        return weighted_sum(
            weights, backend, scene, camera, pose, offsets[0] if offsets else zeros, budget
        )

    return jax.grad(loss)(variables)


def random_weights(seed: int, safe: np.ndarray) -> tuple[jax.Array, ...]:
    """Weights of the pixels that no threshold decides; 0 elsewhere."""
    rng = np.random.default_rng(seed)
    height, width = safe.shape
    return tuple(
        jnp.asarray(rng.standard_normal((height, width, *more)) * mask, dtype=jnp.float32)
        for more, mask in (((3,), safe[..., None]), ((), safe), ((), safe))
    )


def assert_images_agree(scene, camera, pose, offsets=None):
    safe = safe_pixels(scene, camera, pose)
    found, expected = (
        render_with(name, scene, camera, pose, offsets) for name in ("numba", "reference")
    )
    for name, size in (("rgb", 1.0), ("alpha", 1.0), ("depth_sum", 3.0)):
        difference = np.abs(np.asarray(getattr(found, name) - getattr(expected, name)))
        assert difference[safe].max() < 1e-4 * size, name
    return safe, found


def assert_gradients_agree(seed, safe, scene, camera, pose, offsets):
    weights = random_weights(seed, safe)
    variables = (scene, camera, pose, offsets)
    found = gradients_with(weights, "numba", variables)
    expected = gradients_with(weights, "reference", variables)
    paths = jax.tree_util.tree_leaves_with_path(expected)
    for (path, by), ours in zip(paths, jax.tree.leaves(found), strict=True):
        off, whole = np.linalg.norm(ours - by), np.linalg.norm(by)
        assert off <= 1e-3 * whole + 1e-6, (jax.tree_util.keystr(path), off, whole)


seeds = st.integers(0, 10_000)


@settings(max_examples=8)
@given(seeds)
def test_images_and_gradients_agree(seed):
    """Also by the pose, the intrinsics and the projected centers."""
    scene, (camera, pose) = random_cloud(seed, COUNT), view(*SIZE)
    safe, _ = assert_images_agree(scene, camera, pose)
    assert safe.mean() > 0.8
    assert_gradients_agree(seed, safe, scene, camera, pose, jnp.zeros((COUNT, 2)))


@settings(max_examples=6)
@given(seeds)
def test_solid_clouds_agree(seed):
    """Opacities near 1, many layers deep: compositing is cut off at 0.99 and stops at 1e-4."""
    scene, (camera, pose) = random_cloud(seed, COUNT), view(*SIZE)
    scene = dataclasses.replace(
        scene, opacity_logits=jnp.abs(scene.opacity_logits) * 3.0, log_scales=scene.log_scales + 0.7
    )
    safe, found = assert_images_agree(scene, camera, pose)
    assert np.mean(np.asarray(found.alpha) > 0.999) > 0.2
    assert_gradients_agree(seed, safe, scene, camera, pose, jnp.zeros((COUNT, 2)))


@pytest.mark.full
@pytest.mark.parametrize(
    "degree", [0, *(pytest.param(degree, marks=pytest.mark.slow) for degree in (1, 2))]
)
def test_fewer_harmonics_agree(degree):
    scene, (camera, pose) = random_cloud(3, COUNT, degree), view(*SIZE)
    safe, _ = assert_images_agree(scene, camera, pose)
    assert_gradients_agree(3, safe, scene, camera, pose, jnp.zeros((COUNT, 2)))


@pytest.mark.parametrize(
    "size", quick_and_full([(96, 70), (16, 16), (5, 3), (1, 1), (17, 33)], [(17, 33)])
)
def test_sizes_that_are_no_multiple_of_a_tile(size):
    scene, (camera, pose) = random_cloud(4, COUNT), view(*size)
    assert_images_agree(scene, camera, pose)


def test_gaussians_larger_than_the_image():
    """And a camera in the middle of the cloud, where many lie behind or beside it."""
    scene, (camera, pose) = random_cloud(5, COUNT), view(*SIZE, distance=0.3)
    scene = dataclasses.replace(scene, log_scales=scene.log_scales + 2.0)
    safe, found = assert_images_agree(scene, camera, pose)
    assert int(found.num_intersections) > 400
    assert_gradients_agree(5, safe, scene, camera, pose, jnp.zeros((COUNT, 2)))


def test_pose_gradient_is_a_difference_quotient():
    """Moves of the camera along its axes; the Gaussians are broad, so that cut-offs hardly show."""
    scene, (camera, pose) = random_cloud(6, COUNT), view(*SIZE)
    scene = dataclasses.replace(scene, log_scales=jnp.full((COUNT, 3), -1.0))
    columns = jnp.linspace(-1.0, 1.0, SIZE[0])[None, :, None] * jnp.ones((SIZE[1], SIZE[0], 3))
    weights = columns, jnp.ones(SIZE[::-1]), jnp.zeros(SIZE[::-1])

    @jax.jit
    def loss(shift):
        moved = pose.at[:3, 3].add(pose[:3, :3] @ shift)
        return weighted_sum(weights, "numba", scene, camera, moved)

    gradient, step = jax.grad(loss)(jnp.zeros(3)), 0.01
    for axis in range(3):
        shift = jnp.zeros(3).at[axis].set(step)
        quotient = (float(loss(shift)) - float(loss(-shift))) / (2.0 * step)
        assert abs(quotient - float(gradient[axis])) < 0.02 * float(jnp.linalg.norm(gradient))


def test_one_gaussian_and_none_in_sight():
    scene, (camera, pose) = random_cloud(1, 1), view(*SIZE)
    centered = dataclasses.replace(scene, means=jnp.zeros((1, 3)), opacity_logits=jnp.ones(1))
    _, found = assert_images_agree(centered, camera, pose)
    assert float(found.alpha.max()) > 0.5
    behind = dataclasses.replace(centered, means=2.0 * pose[None, :3, 3])
    weights = random_weights(0, np.ones(SIZE[::-1], dtype=bool))
    result = render_with("numba", behind, camera, pose)
    assert float(result.alpha.max()) == float(result.rgb.max()) == 0.0
    assert int(result.num_intersections) == 0
    for leaf in jax.tree.leaves(gradients_with(weights, "numba", (behind, camera, pose))):
        assert float(jnp.abs(leaf).max()) == 0.0


@given(seeds, st.sampled_from(["means", "quats", "log_scales", "opacity_logits", "sh"]))
def test_what_is_not_a_number_is_not_drawn(seed, name):
    """The image is that of the other Gaussians, and all gradients are finite."""
    scene, (camera, pose) = random_cloud(seed, COUNT), view(*SIZE)
    rng = np.random.default_rng(seed)
    values = np.array(getattr(scene, name)).reshape(COUNT, -1)
    broken = rng.choice(COUNT, 10, replace=False)
    values[broken, rng.integers(0, values.shape[1], 10)] = rng.choice([np.nan, -np.nan], 10)
    shape = getattr(scene, name).shape
    spoiled = dataclasses.replace(scene, **{name: jnp.asarray(values.reshape(shape))})
    faded = dataclasses.replace(scene, opacity_logits=scene.opacity_logits.at[broken].set(-50.0))
    found = render_with("numba", spoiled, camera, pose)
    expected = render_with("numba", faded, camera, pose)
    np.testing.assert_array_equal(found.rgb, expected.rgb)
    weights = random_weights(0, np.ones(SIZE[::-1], dtype=bool))
    for leaf in jax.tree.leaves(gradients_with(weights, "numba", (spoiled, camera, pose))):
        assert np.isfinite(leaf).all()


@given(seeds)
def test_wild_numbers_are_survived(seed):
    """Infinite, huge and tiny parameters: nothing is read or written where it should not be."""
    scene, (camera, pose) = random_cloud(seed, COUNT), view(*SIZE)
    rng = np.random.default_rng(seed)
    wild = np.array([np.inf, -np.inf, 1e38, -1e38, 1e19, -1e9, 88.0, -88.0, 1e-38, 0.0])

    def spoil(leaf):
        values = np.where(rng.uniform(size=leaf.shape) < 0.1, rng.choice(wild, leaf.shape), leaf)
        return jnp.asarray(values, dtype=jnp.float32)

    spoiled = jax.tree.map(spoil, scene)
    weights = random_weights(0, np.ones(SIZE[::-1], dtype=bool))
    result = render_with("numba", spoiled, camera, pose)
    alpha = np.asarray(result.alpha)
    assert 0.0 <= alpha.min() <= alpha.max() <= 1.0 + 1e-5
    jax.block_until_ready(gradients_with(weights, "numba", (spoiled, camera, pose)))


def test_overflow_is_counted_and_nothing_is_drawn():
    scene, (camera, pose) = random_cloud(8, COUNT), view(*SIZE)
    needed = int(render_with("numba", scene, camera, pose).num_intersections)
    exact = render_with("numba", scene, camera, pose, None, needed)
    assert int(exact.overflow) == 0
    assert float(exact.alpha.max()) > 0.5
    short = render_with("numba", scene, camera, pose, None, needed - 1)
    assert (int(short.num_intersections), int(short.overflow)) == (needed, 1)
    assert float(short.alpha.max()) == 0.0
    weights = random_weights(0, np.ones(SIZE[::-1], dtype=bool))
    for leaf in jax.tree.leaves(gradients_with(weights, "numba", (scene, camera, pose), 100)):
        assert float(jnp.abs(leaf).max()) == 0.0


def test_intersections_are_the_tiles_that_a_gaussian_touches():
    camera = Camera(64, 48, 50.0, 50.0, 32.0, 24.0)
    pose = jnp.eye(4)

    def needed(scale: float, x: float) -> int:
        scene = GaussianScene(
            means=jnp.asarray([[x, 0.0, 1.0]]),
            quats=jnp.asarray([[1.0, 0.0, 0.0, 0.0]]),
            log_scales=jnp.full((1, 3), jnp.log(scale)),
            opacity_logits=jnp.full(1, 2.0),
            sh=jnp.zeros((1, 1, 3)),
        )
        return int(render_with("numba", scene, camera, pose).num_intersections)

    assert needed(0.001, 0.16) == 1  # 8 pixels right of the middle, in the middle of a tile
    assert needed(10.0, 0.0) == 12
    assert needed(0.001, 100.0) == 0
