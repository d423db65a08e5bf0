"""The reference rasterizer: evaluates every Gaussian at every pixel.

The oracle for all backends.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r3jax.geometry.cameras import Camera
from r3jax.kernels.constants import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from r3jax.splatting.backend import Composite, RasterConfig
from r3jax.splatting.projection import ProjectedGaussians, project_gaussians
from r3jax.splatting.scene import GaussianScene


def rasterize(
    scene: GaussianScene,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    center_offsets: Float[Array, "n 2"],
    config: RasterConfig,
) -> Composite:
    """Composites all Gaussians at every pixel, one image row after the other."""
    del config  # no tiles, no budget
    projected = project_gaussians(scene, camera, T_world_camera, center_offsets)
    order = jnp.argsort(jnp.where(projected.is_drawn, projected.depth, jnp.inf))
    projected = jax.tree.map(lambda x: jnp.take(x, order, axis=-1), projected)
    columns = jnp.arange(camera.width, dtype=jnp.float32) + 0.5

    @jax.checkpoint
    def image_row(v: Float[Array, ""]) -> tuple[Array, Array, Array]:
        return jax.vmap(lambda u: composite_pixel(projected, u, v))(columns)

    rgb, depth, alpha = jax.lax.map(image_row, jnp.arange(camera.height, dtype=jnp.float32) + 0.5)
    zero = jnp.zeros((), dtype=jnp.int32)
    return Composite(rgb=rgb, depth_sum=depth, alpha=alpha, num_intersections=zero, overflow=zero)


def composite_pixel(
    projected: ProjectedGaussians, u: Float[Array, ""], v: Float[Array, ""]
) -> tuple[Float[Array, " 3"], Float[Array, ""], Float[Array, ""]]:
    """Composites one pixel from Gaussians sorted from near to far.

    Returns:
        Color on black, sum of weight x depth, and alpha, at the pixel coordinates (u, v).
    """
    dx, dy = projected.center[0] - u, projected.center[1] - v
    xx, xy, yy = projected.conic
    s = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
    alpha = jnp.minimum(ALPHA_MAX, projected.opacity * jnp.exp(-s))
    alpha = jnp.where(projected.is_drawn & (alpha >= ALPHA_MIN) & (s >= 0.0), alpha, 0.0)
    through = jnp.cumprod(1.0 - alpha)  # transmittance behind each Gaussian
    before = jnp.concatenate([jnp.ones(1), through[:-1]])
    weight = jnp.where(through > TRANSMITTANCE_MIN, before * alpha, 0.0)
    return projected.color @ weight, projected.depth @ weight, weight.sum()
