"""Rasterizer for CPUs, whose machine code is in `kernels`.

Shape symbols: n Gaussians; H W image size.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r3jax.geometry.cameras import Camera, invert_pose
from r3jax.kernels import calls
from r3jax.kernels.calls import Cloud, Drawn, Images
from r3jax.splatting.backend import Composite, RasterConfig
from r3jax.splatting.scene import GaussianScene

_Size = tuple[tuple[int, int], int]
"""Width and height of the image [px], and the budget of intersections."""

_Residuals = tuple[Cloud, Array, Images, Drawn]
"""What the backward pass takes: cloud, view, images, and what else compositing keeps."""


def rasterize(
    scene: GaussianScene,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    center_offsets: Float[Array, "n 2"],
    config: RasterConfig,
) -> Composite:
    """Composites the scene on black, on all cores that the process may use.

    Images and gradients are bit-identical for any number of cores. Pairs beyond the budget are
    counted in `overflow`; the image is then black, and its gradient 0. Gaussians with NaN
    parameters are not drawn and have gradient 0.

    Raises:
        RuntimeError: Numba has no threading layer for parallel renderings.
    """
    images, totals = _composited(*arguments(scene, camera, T_world_camera, center_offsets, config))
    return Composite(
        rgb=images.rgb,
        depth_sum=images.depth,
        alpha=images.alpha,
        num_intersections=totals[0],
        overflow=totals[1],
    )


def arguments(
    scene: GaussianScene,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    center_offsets: Float[Array, "n 2"],
    config: RasterConfig,
) -> tuple[_Size, Cloud, Float[Array, " 19"]]:
    """Lays out sizes, cloud and view as `composite_forward` takes them."""
    T_camera_world = invert_pose(T_world_camera)
    intrinsics = jnp.stack([camera.fx, camera.fy, camera.cx, camera.cy])
    view = jnp.concatenate(
        [T_camera_world[:3, :3].ravel(), T_camera_world[:3, 3], T_world_camera[:3, 3], intrinsics]
    )
    cloud = Cloud(
        scene.means,
        scene.quats,
        scene.log_scales,
        scene.opacity_logits,
        scene.sh.reshape(scene.capacity, -1),
        center_offsets,
    )
    return ((camera.width, camera.height), config.budget(scene.capacity)), cloud, view


def composite_forward(
    size: _Size, cloud: Cloud, view: Float[Array, " 19"]
) -> tuple[tuple[Images, Array], _Residuals]:
    """Composites: images and totals, and what else it has found."""
    images, totals, drawn = calls.composite(cloud, view, *size)
    return (images, totals), (cloud, view, images, drawn)


def _forward(size: _Size, cloud: Cloud, view: Float[Array, " 19"]) -> tuple[Images, Array]:
    return composite_forward(size, cloud, view)[0]


def _backward(
    size: _Size, residuals: _Residuals, gradients: tuple[Images, Any]
) -> tuple[Cloud, Array]:
    del size  # that of the images
    return calls.composite_gradient(*residuals, gradients[0])


_composited = jax.custom_vjp(_forward, nondiff_argnums=(0,))
_composited.defvjp(composite_forward, _backward)
