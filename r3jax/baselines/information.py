"""What the pixels of a view tell of single Gaussians: squared gradients, and weights one by one.

An image's gradient adds up over pixels before anybody can square it; a composited image mixes
Gaussians. These two sums go over (pixel, Gaussian) pairs, in a kernel beside the backward pass of
the `numba` backend. It serves CPUs; on an accelerator's machine they run on its CPU cores.

Shape symbols: n Gaussians; H W image size; V views.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from r3jax.geometry.cameras import Camera
from r3jax.kernels import calls
from r3jax.kernels.calls import Cloud, Drawn, Images
from r3jax.kernels.native.platform import can_call_kernels
from r3jax.splatting.backend import RasterConfig
from r3jax.splatting.backends.numba import arguments, composite_forward
from r3jax.splatting.backends.reference import composite_pixel
from r3jax.splatting.projection import project_gaussians
from r3jax.splatting.scene import GaussianScene

Source = Literal["auto", "numba", "reference"]
"""`reference` differentiates pixel by pixel in plain JAX: the oracle, for small scenes only."""


def pixel_squares(
    scene: GaussianScene,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    background: Float[Array, " 3"],
    config: RasterConfig,
    source: Source = "auto",
) -> tuple[GaussianScene, Int[Array, ""]]:
    """Sums (dC / d parameter)^2 over the pixels of a view, C being the sum of a pixel's channels.

    The diagonal of the Gauss-Newton Hessian that FisherRF (Jiang et al. 2024) ranks views by. A
    color's coefficient moves one channel only, so for it the sum over channels changes nothing.

    Args:
        scene: the Gaussians.
        camera: intrinsics.
        T_world_camera: pose of the view.
        background: RGB behind everything; what shines through counts.
        config: the budget of intersections.
        source: which implementation.

    Returns:
        A sum for every parameter, laid out as the scene; and how many intersections were dropped:
        all sums are 0 then.
    """
    if _is_compiled(source):
        composited, overflow = _composited(scene, camera, T_world_camera, config)
        behind = jnp.sum(background).reshape(1).astype(jnp.float32)
        *geometry, sh = calls.squares(*composited, behind)
        return GaussianScene(*geometry, sh=sh.reshape(scene.sh.shape)), overflow
    return _dense_squares(scene, camera, T_world_camera, background), jnp.zeros((), jnp.int32)


def pixel_tallies(
    scene: GaussianScene,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    value: Float[Array, "H W"],
    counts: Float[Array, "H W"],
    config: RasterConfig,
    *,
    least_through: float = 0.0,
    least_weight: float = 0.0,
    source: Source = "auto",
) -> tuple[Float[Array, "n 2"], Int[Array, ""]]:
    """Sums `value`, times a Gaussian's weight, and `counts` over the pixels of a view.

    Args:
        scene: the Gaussians.
        camera: intrinsics.
        T_world_camera: pose of the view.
        value: what the weight of each pixel is multiplied by.
        counts: what each pixel counts, such as 1.
        config: the budget of intersections.
        least_through: pixels are left out where no more light than this reaches the Gaussian.
        least_weight: pixels are left out where it weighs no more than this.
        source: which implementation.

    Returns:
        Both sums of every Gaussian; and how many intersections were dropped: all sums are 0 then.
    """
    least = jnp.array([least_through, least_weight], dtype=jnp.float32)
    if _is_compiled(source):
        (*_, drawn), overflow = _composited(scene, camera, T_world_camera, config)
        return calls.tallies(drawn, value, counts, least), overflow
    sums = _dense_tallies(scene, camera, T_world_camera, value, counts, least)
    return sums, jnp.zeros((), jnp.int32)


def _composited(
    scene: GaussianScene, camera: Camera, pose: Float[Array, "4 4"], config: RasterConfig
) -> tuple[tuple[Cloud, Array, Images, Drawn], Int[Array, ""]]:
    """Composites a view: the cloud, view, images and lists for the kernels; and the overflow."""
    zeros = jnp.zeros((scene.capacity, 2))
    (_, totals), found = composite_forward(*arguments(scene, camera, pose, zeros, config))
    return found, totals[1]


def with_room(
    function: Callable[..., tuple[Any, Int[Array, "..."]]], scene: GaussianScene, *args: Any
) -> Any:
    """Calls `function(config, scene, *args)` with a budget that every view fits into.

    Not to be called under jit: a view that overflows is rendered again, with a larger budget.
    """
    config = RasterConfig()
    result, overflow = function(config, scene, *args)
    while (missing := int(jnp.max(overflow))) > 0:
        config = config.with_room(config.budget(scene.capacity) + missing)
        result, overflow = function(config, scene, *args)
    return result


def on_cpu(tree: Any) -> Any:
    """Moves arrays to where the kernel is; a no-op where there is nothing but a CPU."""
    return jax.device_put(tree, jax.devices("cpu")[0])


def _is_compiled(source: Source) -> bool:
    if source == "auto":
        return can_call_kernels()
    return source == "numba"


@partial(jax.jit, static_argnames="camera_size")
def _rows(
    camera_size: tuple[int, int], scene: GaussianScene, camera: Camera, pose: Array, behind: Array
) -> GaussianScene:
    """Sums squared gradients, one row of pixels after the other."""
    width, height = camera_size
    columns = jnp.arange(width, dtype=jnp.float32) + 0.5

    def channel_sum(scene: GaussianScene, u: Array, v: Array) -> Array:
        projected = project_gaussians(scene, camera, pose, jnp.zeros((scene.capacity, 2)))
        order = jnp.argsort(jnp.where(projected.is_drawn, projected.depth, jnp.inf))
        projected = jax.tree.map(lambda x: jnp.take(x, order, axis=-1), projected)
        rgb, _, alpha = composite_pixel(projected, u, v)
        return rgb.sum() + (1.0 - alpha) * behind.sum()

    def add_row(total: GaussianScene, v: Array) -> tuple[GaussianScene, None]:
        gradients = jax.vmap(jax.grad(channel_sum), in_axes=(None, 0, None))(scene, columns, v)
        return jax.tree.map(lambda t, g: t + jnp.sum(g * g, axis=0), total, gradients), None

    rows = jnp.arange(height, dtype=jnp.float32) + 0.5
    return jax.lax.scan(add_row, jax.tree.map(jnp.zeros_like, scene), rows)[0]


def _dense_squares(
    scene: GaussianScene, camera: Camera, pose: Float[Array, "4 4"], behind: Float[Array, " 3"]
) -> GaussianScene:
    return _rows((camera.width, camera.height), scene, camera, pose, behind)


def _dense_tallies(
    scene: GaussianScene,
    camera: Camera,
    pose: Float[Array, "4 4"],
    value: Float[Array, "H W"],
    counts: Float[Array, "H W"],
    least: Float[Array, " 2"],
) -> Float[Array, "n 2"]:
    projected = project_gaussians(scene, camera, pose, jnp.zeros((scene.capacity, 2)))
    order = jnp.argsort(jnp.where(projected.is_drawn, projected.depth, jnp.inf))
    drawn = jax.tree.map(lambda x: jnp.take(x, order, axis=-1), projected)
    columns = jnp.arange(camera.width, dtype=jnp.float32) + 0.5

    def weights(u: Array, v: Array) -> Array:
        # How fast a pixel's red grows with the red of a Gaussian: that is its weight.
        def red(color: Array) -> Array:
            return composite_pixel(eqx.tree_at(lambda p: p.color, drawn, color), u, v)[0][0]

        return jax.grad(red)(drawn.color)[0]

    def add_row(total: Array, row: tuple[Array, Array, Array]) -> tuple[Array, None]:
        v, values, marks = row
        weight = jax.vmap(weights, in_axes=(0, None))(columns, v)
        # What reaches a Gaussian: weights in front of it have taken the rest.
        through = 1.0 - (jnp.cumsum(weight, axis=1) - weight)
        is_counted = (weight > least[1]) & (through > least[0])
        sums = jnp.stack(
            [
                jnp.sum(jnp.where(is_counted, weight * values[:, None], 0.0), axis=0),
                jnp.sum(jnp.where(is_counted, marks[:, None], 0.0), axis=0),
            ],
            axis=1,
        )
        return total + sums, None

    rows = (jnp.arange(camera.height, dtype=jnp.float32) + 0.5, value, counts)
    sums, _ = jax.lax.scan(add_row, jnp.zeros((scene.capacity, 2)), rows)
    return jnp.zeros_like(sums).at[order].set(sums)
