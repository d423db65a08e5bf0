"""The public `render`: background, depth, budgets, errors; the same for every backend."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import r3jax.splatting.backend as backend_module
from r3jax.splatting.backend import RasterConfig
from r3jax.splatting.render import render
from r3jax.splatting.scene import GaussianScene, empty_scene
from tests.splatting.clouds import random_cloud, safe_pixels, view

COUNT = 120
SIZE = (50, 38)
BACKENDS = ["xla", "numba"]


def config(backend: str, budget: int | None = 1 << 13) -> RasterConfig:
    return RasterConfig(backend=backend, max_intersections=budget)


@pytest.fixture(scope="module", params=BACKENDS)
def backend(request):
    return request.param


def test_backends_agree(backend):
    scene, (camera, pose) = random_cloud(7, COUNT), view(*SIZE)
    background = jnp.asarray([0.1, 0.5, 0.9])
    expected = render(scene, camera, pose, background, config("reference"))
    found = render(scene, camera, pose, background, config(backend))
    safe = safe_pixels(scene, camera, pose)
    assert safe.mean() > 0.85
    for name in ("rgb", "alpha"):
        difference = np.abs(np.asarray(getattr(found, name) - getattr(expected, name)))
        assert difference[safe].max() < 1e-4, name
    solid = safe & (np.asarray(expected.alpha) > 0.05)
    np.testing.assert_allclose(found.depth[solid], expected.depth[solid], rtol=1e-3)


def test_background_fills_what_is_empty(backend):
    camera, pose = view(*SIZE)
    background = jnp.asarray([0.2, 0.4, 0.6])
    image = render(empty_scene(COUNT), camera, pose, background, config(backend))
    np.testing.assert_allclose(image.rgb, np.broadcast_to([0.2, 0.4, 0.6], image.rgb.shape))
    assert float(jnp.abs(image.alpha).max()) == float(jnp.abs(image.depth).max()) == 0.0


def test_depth_of_a_wall(backend):
    """A wall 2 m in front of the camera has z-depth 2 m wherever it is opaque."""
    camera, pose = view(*SIZE)
    grid = np.stack(np.meshgrid(np.linspace(-1.5, 1.5, 12), np.linspace(-1.2, 1.2, 10)), -1)
    points = np.concatenate([grid.reshape(-1, 2), np.full((COUNT, 1), 2.0)], axis=1)
    means = points @ np.asarray(pose)[:3, :3].T + np.asarray(pose)[:3, 3]
    scene = GaussianScene(
        means=jnp.asarray(means, dtype=jnp.float32),
        quats=jnp.tile(jnp.asarray([1.0, 0.0, 0.0, 0.0]), (COUNT, 1)),
        log_scales=jnp.full((COUNT, 3), np.log(0.2), dtype=jnp.float32),
        opacity_logits=jnp.full(COUNT, 3.0),
        sh=jnp.zeros((COUNT, 16, 3)),
    )
    image = render(scene, camera, pose, config=config(backend))
    middle = (slice(9, 29), slice(12, 38))
    assert float(image.alpha[middle].min()) > 0.9
    np.testing.assert_allclose(image.depth[middle], 2.0, rtol=1e-4)


def test_overflow_is_counted_and_spoils_the_image(backend):
    scene, (camera, pose) = random_cloud(8, COUNT), view(*SIZE)
    full = render(scene, camera, pose, config=config(backend))
    needed = int(full.num_intersections)
    assert needed > 256
    image = render(scene, camera, pose, config=config(backend, 256))
    assert int(image.num_intersections) == needed
    assert int(image.overflow) == needed - 256
    for name in ("rgb", "depth", "alpha"):
        assert np.isnan(getattr(image, name)).all()


def test_an_open_budget_is_raised_outside_jit(backend, monkeypatch):
    """And so the image is complete although the first guess was far too small."""
    scene, (camera, pose) = random_cloud(8, COUNT), view(*SIZE)
    expected = render(scene, camera, pose, config=config(backend))
    monkeypatch.setattr(RasterConfig, "budget", lambda self, n: self.max_intersections or 64)
    image = render(scene, camera, pose, config=config(backend, None))
    assert int(image.overflow) == 0
    np.testing.assert_allclose(image.rgb, expected.rgb, atol=1e-5)


@pytest.mark.full
def test_gradients_by_background_and_offsets(backend):
    """Moving all centers by a pixel moves the image: the offsets' gradient is the centers'."""
    scene, (camera, pose) = random_cloud(9, COUNT), view(*SIZE)
    weight = jnp.asarray(np.random.default_rng(0).normal(size=(SIZE[1], SIZE[0], 3)), jnp.float32)

    def loss(background, offsets, name):
        image = render(scene, camera, pose, background, config(name), center_offsets=offsets)
        return jnp.sum(image.rgb * weight)

    arguments = (jnp.asarray([0.3, 0.2, 0.1]), jnp.zeros((COUNT, 2)))
    expected = jax.grad(loss, argnums=(0, 1))(*arguments, "reference")
    found = jax.grad(loss, argnums=(0, 1))(*arguments, backend)
    for one, other in zip(found, expected, strict=True):
        assert np.linalg.norm(one - other) < 1e-3 * np.linalg.norm(other)


@pytest.mark.full
def test_gradients_by_intrinsics(backend):
    scene, (camera, pose) = random_cloud(10, COUNT), view(*SIZE)

    def loss(camera, name):
        image = render(scene, camera, pose, config=config(name))
        return jnp.sum(image.rgb * jnp.arange(SIZE[0], dtype=jnp.float32)[None, :, None])

    expected = jax.grad(loss)(camera, "reference")
    found = jax.grad(loss)(camera, backend)
    for name in ("fx", "fy", "cx", "cy"):
        scale = abs(float(expected.cx)) + abs(float(expected.cy))
        difference = float(getattr(found, name)) - float(getattr(expected, name))
        assert abs(difference) < 1e-3 * (abs(float(getattr(expected, name))) + scale), name


def test_an_unknown_backend_is_refused_by_name():
    with pytest.raises(ValueError, match="'cuda'"):
        backend_module.find_backend("cuda")


def test_auto_takes_numba_on_a_cpu():
    if jax.default_backend() != "cpu":
        pytest.skip("needs a CPU as JAX's device")
    from r3jax.splatting.backends.numba import rasterize

    assert backend_module.find_backend("auto") is rasterize


@pytest.mark.parametrize("needed", [1, 1000, 5000, 123_456, 3_000_000])
def test_fitting_budgets_are_few_and_large_enough(needed):
    budget = RasterConfig().with_room(needed).max_intersections
    assert max(1.2 * needed, 1000) <= budget <= max(1.6 * needed, 1300)
    # Slightly other needs fall on the same number: no new compilation.
    assert (
        len(
            {
                RasterConfig().with_room(int(needed * f)).max_intersections
                for f in np.linspace(0.9, 1.1, 9)
            }
        )
        <= 3
    )
