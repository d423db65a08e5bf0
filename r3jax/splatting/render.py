"""Renders a scene of Gaussians: one signature over all backends."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from r3jax.geometry.arguments import a_camera, a_point, a_pose, checked, one, or_none
from r3jax.geometry.cameras import Camera, is_traced, nan_unless_valid
from r3jax.splatting.backend import Composite, RasterConfig, find_backend
from r3jax.splatting.scene import GaussianScene, a_scene


class Rendering(eqx.Module):
    """One rendered view."""

    rgb: Float[Array, "H W 3"]
    """Color over the background; it may exceed 1."""

    depth: Float[Array, "H W"]
    """Expected z-depth [m]: mean over the Gaussians by their weights; 0 where there is none."""

    alpha: Float[Array, "H W"]
    """Opacity of the pixel in [0, 1)."""

    num_intersections: Int[Array, ""]
    """Pairs of tile and Gaussian that the view needs."""

    overflow: Int[Array, ""]
    """Number of dropped pairs; if there are any, the images are NaN."""


@checked(
    scene=a_scene,
    camera=a_camera,
    T_world_camera=a_pose,
    background=or_none(a_point),
    config=or_none(one(RasterConfig, "None: its defaults")),
)
def render(
    scene: GaussianScene,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    background: Float[Array, " 3"] | None = None,
    config: RasterConfig | None = None,
    *,
    center_offsets: Float[Array, "n 2"] | None = None,
) -> Rendering:
    """Renders one view by EWA splatting (Kerbl et al. 2023).

    Differentiable by the scene, the pose, the intrinsics and the background. The budget of
    intersections is fixed while tracing: if a view needs more, `overflow` counts the dropped ones
    and the images are NaN, because an image without some Gaussians would look plausible. Outside
    jit (and if the config sets no budget) it is raised until the view fits. A pose that is not
    rigid is refused outside jit, and gives NaN under it.

    Args:
        scene: the Gaussians.
        camera: intrinsics.
        T_world_camera: camera-to-world pose, OpenCV axes [m].
        background: RGB behind everything; black by default.
        config: backend and budget.
        center_offsets: added to the projected centers [px]; zeros by default. Their gradient is
            that of the projected centers, which densification uses.

    Returns:
        Color, expected depth and alpha.

    Raises:
        TypeError: arguments of another type.
        ValueError: shapes that do not fit together, a pose that is not rigid, or an unknown
            backend.
        ImportError: the backend's packages are not installed.
    """
    config = RasterConfig() if config is None else config
    background = jnp.zeros(3) if background is None else background
    if center_offsets is None:
        center_offsets = jnp.zeros((scene.capacity, 2))
    rasterize = find_backend(config.backend)
    composite = rasterize(scene, camera, T_world_camera, center_offsets, config)
    is_open = config.max_intersections is None and not is_traced(composite.overflow)
    while is_open and int(composite.overflow) > 0:
        config = config.with_room(int(composite.num_intersections))
        composite = rasterize(scene, camera, T_world_camera, center_offsets, config)
    return _finish(composite, background, nan_unless_valid(camera, T_world_camera))


def _finish(
    composite: Composite, background: Float[Array, " 3"], factor: Float[Array, ""]
) -> Rendering:
    """Adds the background, divides depth by alpha, and sets overflowed images to NaN.

    Args:
        composite: the Gaussians.
        background: RGB behind them.
        factor: 1, or NaN for an invalid view.
    """
    alpha = composite.alpha
    covered = alpha > 0.0
    depth = jnp.where(covered, composite.depth_sum / jnp.where(covered, alpha, 1.0), 0.0)
    rgb = composite.rgb + (1.0 - alpha)[..., None] * background[None, None, :]
    spoil = jnp.where(composite.overflow > 0, jnp.nan, 0.0) * factor
    return Rendering(
        rgb=rgb + spoil,
        depth=depth + spoil,
        alpha=alpha + spoil,
        num_intersections=composite.num_intersections,
        overflow=composite.overflow,
    )
