"""The adapter to splax: what it asks of the package, told by a fake where it is absent.

The fake follows the documented conventions of `splax.project` and `splax.rasterize_depth`
(world-to-camera matrix, linear scales, wxyz, opacities in [0, 1], intrinsics as plain numbers,
depth divided by alpha). So the readable rasterizer must come out, with all its gradients. With
the package and a GPU, `test_golden.py` runs the real one.
"""

import importlib.util
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.geometry.cameras import invert_pose
from r3jax.kernels.constants import DILATION, NEAR_PLANE
from r3jax.splatting.backend import RasterConfig, find_backend
from r3jax.splatting.backends import reference, splax
from r3jax.splatting.projection import ProjectedGaussians, rotation_rows
from r3jax.splatting.scene import GaussianScene
from tests.splatting.clouds import random_cloud, view

pytestmark = pytest.mark.full

COUNT, SIZE = 60, (40, 22)
CONFIG = RasterConfig()


def project(means, scales, quats, viewmat, *, opacities, img_shape, f, c, clip_thresh):
    """EWA projection through a matrix that need not be rigid."""
    assert all(isinstance(number, float) for number in (*f, *c, clip_thresh))
    W = viewmat[:3, :3]
    x, y, z = (means @ W.T + viewmat[None, :3, 3]).T
    limits = [1.3 * 0.5 * img_shape[1 - i] / f[i] for i in range(2)]
    u, v = jnp.clip(x / z, -limits[0], limits[0]), jnp.clip(y / z, -limits[1], limits[1])
    zero = jnp.zeros_like(z)
    J = jnp.stack([f[0] / z, zero, -f[0] * u / z, zero, f[1] / z, -f[1] * v / z], -1)
    rotation = jnp.stack([jnp.stack(row, -1) for row in rotation_rows(quats)], -2)
    factor = J.reshape(-1, 2, 3) @ W @ (rotation * scales[:, None, :])
    cov = factor @ jnp.swapaxes(factor, 1, 2) + DILATION * jnp.eye(2)[None]
    inverse = jnp.linalg.inv(cov)
    conics = jnp.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], -1)
    centers = jnp.stack([f[0] * x / z + c[0], f[1] * y / z + c[1]], -1)
    radii = jnp.where((z > clip_thresh) & (opacities > 1 / 255), 100, 0)
    tiles = jnp.minimum(radii, 1)
    return centers, z, radii, conics, tiles, jnp.cumsum(tiles)


def rasterize_depth(
    colors, opacities, background, centers, depths, radii, conics, tiles_so_far, *, img_shape
):
    """Pixel by pixel; the image with the mean depth as its fourth channel, and alpha."""
    order = jnp.argsort(depths)
    projected = ProjectedGaussians(
        center=centers[order].T,
        conic=conics[order].T,
        depth=depths[order],
        opacity=opacities[order],
        color=colors[order].T,
        reach=jnp.where(radii[order] > 0, 1.0, -1.0)[None, :] * jnp.ones((2, 1)),
    )
    assert tiles_so_far.shape == depths.shape
    pixels = [jnp.arange(size, dtype=jnp.float32) + 0.5 for size in img_shape]
    row = jax.vmap(reference.composite_pixel, (None, 0, None))
    rgb, depth, alpha = jax.vmap(row, (None, None, 0))(projected, pixels[1], pixels[0])
    depth = jnp.where(alpha > 0, depth / jnp.where(alpha > 0, alpha, 1.0), 0.0)
    image = rgb + (1.0 - alpha[..., None]) * background[None, None, :]
    return jnp.concatenate([image, depth[..., None]], axis=-1), alpha


@pytest.fixture
def stand_in(monkeypatch):
    """splax as it would be on a machine with a GPU."""
    module = SimpleNamespace(project=project, rasterize_depth=rasterize_depth)
    monkeypatch.setattr(splax, "load_splax", lambda: module)


def loss(rasterize, scene, camera, pose, offsets):
    result = rasterize(scene, camera, pose, offsets, CONFIG)
    columns = jnp.linspace(-1.0, 1.0, SIZE[0])[None, :] + jnp.linspace(0.0, 2.0, SIZE[1])[:, None]
    images = (*jnp.moveaxis(result.rgb, -1, 0), result.depth_sum, result.alpha)
    return sum(jnp.sum(image * columns * (i + 1)) for i, image in enumerate(images)), result


def test_images_and_gradients_are_those_of_the_reference(stand_in):
    """By the parameters, the intrinsics, the pose and the projected centers."""
    camera, pose = view(*SIZE)
    variables = (random_cloud(2, COUNT), camera, pose, jnp.zeros((COUNT, 2)))

    def step(rasterize):
        by_all = jax.value_and_grad(loss, argnums=(1, 2, 3, 4), has_aux=True)
        return jax.jit(lambda *v: by_all(rasterize, *v))(*variables)

    (_, found), by_found = step(splax.rasterize)
    (_, expected), by_expected = step(reference.rasterize)
    # One pixel in a thousand may lie on a threshold.
    for name in ("rgb", "depth_sum", "alpha"):
        difference = np.abs(np.asarray(getattr(found, name) - getattr(expected, name)))
        assert np.mean(difference > 1e-4) < 1e-3, name
    paths = jax.tree_util.tree_leaves_with_path(by_expected)
    for (path, by), ours in zip(paths, jax.tree.leaves(by_found), strict=True):
        off, whole = np.linalg.norm(ours - by), np.linalg.norm(by)
        assert off <= 1e-3 * whole, (jax.tree_util.keystr(path), off, whole)
    assert int(found.overflow) == 0
    assert int(found.num_intersections) > 0


def test_moved_centers_cannot_be_drawn(stand_in):
    """splax counted their tiles where they were: better no image than a wrong one."""
    camera, pose = view(*SIZE)
    offsets = jnp.zeros((COUNT, 2)).at[3, 1].set(0.5)
    result = splax.rasterize(random_cloud(2, COUNT), camera, pose, offsets, CONFIG)
    assert np.isnan(result.rgb).all()
    assert np.isnan(result.alpha).all()


def test_what_is_not_a_number_does_not_reach_the_kernels(stand_in):
    camera, pose = view(*SIZE)
    scene = random_cloud(2, COUNT)
    broken = GaussianScene(
        scene.means.at[4].set(jnp.nan), scene.quats, scene.log_scales, scene.opacity_logits,
        scene.sh,
    )  # fmt: skip
    by = jax.grad(lambda s: loss(splax.rasterize, s, camera, pose, jnp.zeros((COUNT, 2)))[0])
    for leaf in jax.tree.leaves(by(broken)):
        assert np.isfinite(leaf).all()


def test_the_view_matrix_gives_our_pixels():
    camera, pose = view(*SIZE)
    points = np.random.default_rng(0).normal(size=(30, 3)) @ np.diag([1.0, 1.0, 0.2])
    rows = np.asarray(splax.pixel_view(camera, pose, 40.0), dtype=np.float64)
    x, y, z = rows[:3, :3] @ points.T + rows[:3, 3:]
    true = np.asarray(invert_pose(pose), dtype=np.float64)
    X, Y, Z = true[:3, :3] @ points.T + true[:3, 3:]
    np.testing.assert_allclose(z, Z, rtol=1e-6)
    np.testing.assert_allclose(40 * x / z + 20, camera.fx * X / Z + camera.cx, rtol=1e-4)
    np.testing.assert_allclose(40 * y / z + 11, camera.fy * Y / Z + camera.cy, rtol=1e-4)
    assert z.min() > NEAR_PLANE


def test_without_the_package_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "splax", None)
    camera, pose = view(*SIZE)
    with pytest.raises(ImportError, match=r"pip install 'r3jax\[gpu\]'"):
        find_backend("splax")(random_cloud(2, 3), camera, pose, jnp.zeros((3, 2)), CONFIG)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="there is a GPU")
def test_without_a_gpu_the_error_names_the_platform(monkeypatch):
    monkeypatch.setitem(sys.modules, "splax", SimpleNamespace())
    with pytest.raises(RuntimeError, match="'cpu'"):
        splax.load_splax()


@pytest.mark.skipif(importlib.util.find_spec("splax") is None, reason="splax is not installed")
@pytest.mark.skipif(jax.default_backend() == "cpu", reason="there is no GPU")
def test_the_package_draws_what_the_reference_draws():
    """Opacities below 0.99, from where on splax cuts alpha off elsewhere."""
    camera, pose = view(*SIZE)
    scene = random_cloud(2, COUNT)
    scene = GaussianScene(
        scene.means, scene.quats, scene.log_scales, jnp.minimum(scene.opacity_logits, 4.0), scene.sh
    )
    zeros = jnp.zeros((COUNT, 2))
    (_, found), by_found = jax.value_and_grad(
        lambda s: loss(splax.rasterize, s, camera, pose, zeros), has_aux=True
    )(scene)
    (_, expected), by_expected = jax.value_and_grad(
        lambda s: loss(reference.rasterize, s, camera, pose, zeros), has_aux=True
    )(scene)
    difference = np.abs(np.asarray(found.rgb - expected.rgb)).max(axis=-1)
    assert np.mean(difference > 1e-4) < 1e-2
    for ours, by in zip(jax.tree.leaves(by_found), jax.tree.leaves(by_expected), strict=True):
        assert np.linalg.norm(ours - by) < 1e-2 * np.linalg.norm(by)
