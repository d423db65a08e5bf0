"""Compositing by the kernels of `splax` (Warp, NVIDIA GPUs), with our conventions.

splax takes intrinsics as numbers known while compiling. Here they go into the view matrix
instead: a point at (x, y, z) of a camera with (fx, fy, cx, cy) has the pixel that A (x, y, z) has
in a fixed camera, A being linear; the Jacobian follows by the chain rule, so all gradients are
exact. Colors come from `projection.py`.

What remains different from the other backends: alpha is cut off at 0.999 instead of 0.99, depths
are sorted in as many bits as the tile leaves of 32, and sums are added up in any order.
"""

import importlib
import os
from types import ModuleType

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r3jax.geometry.cameras import Camera, invert_pose
from r3jax.kernels.constants import NEAR_PLANE
from r3jax.splatting.backend import Composite, RasterConfig
from r3jax.splatting.projection import view_colors, without_nans
from r3jax.splatting.scene import GaussianScene


def rasterize(
    scene: GaussianScene,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    center_offsets: Float[Array, "n 2"],
    config: RasterConfig,
) -> Composite:
    """Composites the scene on black; see `backend.Rasterize`.

    `center_offsets` is for its gradient: splax has counted the tiles of the centers before they
    could be moved, so that offsets other than 0 make the images NaN.

    There is no budget: splax allocates what a view needs.

    Raises:
        ImportError: splax is not installed; the message names the extra.
        RuntimeError: there is no NVIDIA GPU.
    """
    del config
    splax = load_splax()
    scene = without_nans(scene)
    image_shape, focal = (camera.height, camera.width), float(max(camera.height, camera.width))
    opacities = jax.nn.sigmoid(scene.opacity_logits)
    centers, depths, radii, conics, tiles, tiles_so_far = splax.project(
        scene.means,
        jnp.exp(scene.log_scales),
        scene.quats,
        pixel_view(camera, T_world_camera, focal),
        opacities=opacities,
        img_shape=image_shape,
        f=(focal, focal),
        c=(0.5 * camera.width, 0.5 * camera.height),
        clip_thresh=NEAR_PLANE,
    )
    colors = view_colors(scene.sh, scene.means, T_world_camera[:3, 3]).T
    image, alpha = splax.rasterize_depth(
        colors,
        opacities,
        jnp.zeros(3),
        centers + (center_offsets - jax.lax.stop_gradient(center_offsets)),
        depths,
        radii,
        conics,
        tiles_so_far,
        img_shape=image_shape,
    )
    spoil = jnp.where((center_offsets != 0.0).any(), jnp.nan, 0.0)
    return Composite(
        rgb=image[..., :3] + spoil,
        depth_sum=image[..., 3] * alpha + spoil,
        alpha=alpha + spoil,
        num_intersections=jnp.sum(tiles).astype(jnp.int32),
        overflow=jnp.zeros((), dtype=jnp.int32),
    )


def pixel_view(
    camera: Camera, T_world_camera: Float[Array, "4 4"], focal: float
) -> Float[Array, "4 4"]:
    """Computes the view matrix that gives our pixels in a centered camera with square pixels.

    Args:
        camera: intrinsics.
        T_world_camera: camera-to-world pose.
        focal: focal length of the centered camera [px].

    Returns:
        World-to-camera matrix, its upper rows sheared and stretched; the third, depth, is kept.
    """
    shift_x = (camera.cx - 0.5 * camera.width) / focal
    shift_y = (camera.cy - 0.5 * camera.height) / focal
    T = invert_pose(T_world_camera)
    rows = [
        camera.fx / focal * T[0] + shift_x * T[2],
        camera.fy / focal * T[1] + shift_y * T[2],
        T[2],
        T[3],
    ]
    return jnp.stack(rows)


def load_splax() -> ModuleType:
    """Imports splax.

    Raises:
        ImportError: it is not installed; the message names the extra.
        RuntimeError: there is no NVIDIA GPU.
    """
    # splax refuses to be imported after SciPy unless this is set. It is about SciPy on arrays
    # that are not NumPy's, which splax only uses in parts that we do not.
    os.environ.setdefault("SCIPY_ARRAY_API", "1")
    try:
        splax = importlib.import_module("splax")
    except ImportError as error:
        raise ImportError(
            "the rasterizer backend 'splax' needs packages that are not installed: "
            "pip install 'r3jax[gpu]', or choose another backend"
        ) from error
    if jax.default_backend() not in ("gpu", "cuda"):
        raise RuntimeError(
            "the rasterizer backend 'splax' needs an NVIDIA GPU, and JAX runs on "
            f"{jax.default_backend()!r}: choose backend 'auto' or 'xla'"
        )
    return splax
