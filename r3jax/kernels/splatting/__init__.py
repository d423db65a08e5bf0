"""Rasterizer for CPUs: projection, binning, sort, compositing and all gradients in Numba."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from r3jax.geometry.cameras import Camera, invert_pose
from r3jax.kernels.native.ffi import num_workers
from r3jax.kernels.splatting import records
from r3jax.kernels.splatting.bridge import (
    BACKWARD,
    FORWARD,
    SQUARES,
    TALLIES,
    register,
    register_per_gaussian,
)
from r3jax.splatting.backend import Composite
from r3jax.splatting.config import TILE, RasterConfig
from r3jax.splatting.scene import GaussianScene

_Size = tuple[int, int, int]
"""Width and height of the image [px], and the budget of intersections."""

_Cloud = tuple[Array, ...]
"""The scene's arrays and the center offsets, as `forward_pass` takes them."""

_Images = tuple[Array, Array, Array, Array]
"""RGB, depth, alpha, and the two totals."""

_Residuals = tuple[_Cloud, Array, tuple[Array, ...], tuple[Array, ...]]
"""Cloud, view, images, and what the kernels keep for the backward pass."""


def rasterize(
    scene: GaussianScene,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    center_offsets: Float[Array, "n 2"],
    config: RasterConfig,
) -> Composite:
    """Composites the scene on black, on as many cores as the process may use.

    The same view gives the same bits, images and gradients, on any number of cores. What
    exceeds the budget is counted in `overflow`; the image is black then, its gradient 0. A
    Gaussian with a parameter that is not a number is not drawn and gets gradient 0.

    Raises:
        RuntimeError: Numba has no threading layer that serves two renderings at once.
    """
    register()
    size, cloud, view = _arguments(scene, camera, T_world_camera, center_offsets, config)
    rgb, depth, alpha, totals = _composite(size, cloud, view)
    return Composite(
        rgb=rgb,
        depth_sum=depth,
        alpha=alpha,
        num_intersections=totals[0],
        overflow=totals[1],
    )


def squared_gradients(
    scene: GaussianScene,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    background: Float[Array, " 3"],
    config: RasterConfig,
) -> tuple[GaussianScene, Int[Array, ""]]:
    """Sums over pixels of squared gradients (`information.pixel_squares`), and the overflow."""
    register_per_gaussian()
    zeros = jnp.zeros((scene.capacity, 2))
    size, cloud, view = _arguments(scene, camera, T_world_camera, zeros, config)
    (*_, totals), (_, _, images, kept) = _composite_forward(size, cloud, view)
    shapes = [jax.ShapeDtypeStruct(x.shape, jnp.float32) for x in cloud[:5]]
    workers = np.array([num_workers()], dtype=np.int32)
    call = jax.ffi.ffi_call(SQUARES, shapes, vmap_method="sequential")
    behind = jnp.sum(background).reshape(1).astype(jnp.float32)
    *geometry, sh = call(*cloud, view, workers, *images, *kept, behind)
    return GaussianScene(*geometry, sh=sh.reshape(scene.sh.shape)), totals[1]


def tallies(
    scene: GaussianScene,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    value: Float[Array, "H W"],
    counts: Float[Array, "H W"],
    least: Float[Array, " 2"],
    config: RasterConfig,
) -> tuple[Float[Array, "n 2"], Int[Array, ""]]:
    """Sums over pixels of single weights (`information.pixel_tallies`), and the overflow."""
    register_per_gaussian()
    zeros = jnp.zeros((scene.capacity, 2))
    size, cloud, view = _arguments(scene, camera, T_world_camera, zeros, config)
    (*_, totals), (_, _, _, kept) = _composite_forward(size, cloud, view)
    shape = jax.ShapeDtypeStruct((scene.capacity, 2), jnp.float32)
    workers = np.array([num_workers()], dtype=np.int32)
    call = jax.ffi.ffi_call(TALLIES, shape, vmap_method="sequential")
    return call(*kept, workers, value, counts, least), totals[1]


def _arguments(
    scene: GaussianScene,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    center_offsets: Float[Array, "n 2"],
    config: RasterConfig,
) -> tuple[_Size, _Cloud, Float[Array, " 19"]]:
    """Sizes, cloud and view, as the passes take them."""
    T_camera_world = invert_pose(T_world_camera)
    intrinsics = jnp.stack([camera.fx, camera.fy, camera.cx, camera.cy])
    view = jnp.concatenate(
        [T_camera_world[:3, :3].ravel(), T_camera_world[:3, 3], T_world_camera[:3, 3], intrinsics]
    )
    cloud = (
        scene.means,
        scene.quats,
        scene.log_scales,
        scene.opacity_logits,
        scene.sh.reshape(scene.capacity, -1),
        center_offsets,
    )
    return (camera.width, camera.height, config.budget(scene.capacity)), cloud, view


def _images_and_totals(size: _Size, cloud: _Cloud, view: Float[Array, " 19"]) -> _Images:
    return _composite_forward(size, cloud, view)[0]


def _composite_forward(
    size: _Size, cloud: _Cloud, view: Float[Array, " 19"]
) -> tuple[_Images, _Residuals]:
    width, height, budget = size
    tiles = -(-width // TILE) * -(-height // TILE)
    result = jax.ShapeDtypeStruct
    shapes = [
        result((height, width, 3), jnp.float32),
        result((height, width), jnp.float32),
        result((height, width), jnp.float32),
        result((2,), jnp.int32),
        result((cloud[0].shape[0], records.SIZE), jnp.float32),
        result((budget,), jnp.int32),
        result((budget,), jnp.int32),
        result((budget,), jnp.uint8),
        result((tiles + 1,), jnp.int32),
        result((tiles,), jnp.int32),
    ]
    workers = np.array([num_workers()], dtype=np.int32)
    call = jax.ffi.ffi_call(FORWARD, shapes, vmap_method="sequential")
    results = tuple(call(*cloud, view, workers))
    rgb, depth, alpha, totals = results[:4]
    return (rgb, depth, alpha, totals), (cloud, view, results[:3], results[4:])


def _composite_backward(
    size: _Size, residuals: _Residuals, gradients: tuple[Any, ...]
) -> tuple[_Cloud, Float[Array, " 19"]]:
    cloud, view, images, kept = residuals
    shapes = [jax.ShapeDtypeStruct(x.shape, jnp.float32) for x in (*cloud, view)]
    workers = np.array([num_workers()], dtype=np.int32)
    call = jax.ffi.ffi_call(BACKWARD, shapes, vmap_method="sequential")
    by_all = tuple(call(*cloud, view, workers, *images, *kept, *gradients[:3]))
    return by_all[:-1], by_all[-1]


_composite = jax.custom_vjp(_images_and_totals, nondiff_argnums=(0,))
_composite.defvjp(_composite_forward, _composite_backward)
