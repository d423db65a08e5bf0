"""Renderability: how well a voxel, and so a view, could be rendered; in closed form.

    R = bias x noise x resolution        (arXiv 2601.07484)

Shape symbols: n voxels; N capacity of the map; h w size of the depth buffer.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from r3jax.errors import InputError
from r3jax.geometry.arguments import a_point, checked
from r3jax.geometry.cameras import Camera, is_traced, nan_unless_valid
from r3jax.kernels.calls import Forms
from r3jax.mapping.state import MapState, a_map
from r3jax.scoring.backend import mean_in_pixels, rows_in_pixels
from r3jax.scoring.config import Score, ScoringConfig, checked_view
from r3jax.scoring.formulas import voxels_of_rows
from r3jax.scoring.terms import Renderability, score_voxels
from r3jax.visibility.views import pinhole_view


@jax.jit
def _voxel_renderability(
    state: MapState, camera_position: Float[Array, " 3"], focal: Float[Array, ""], score: Score
) -> Renderability:
    positive = jnp.stack([focal, state.voxel_size])
    is_valid = jnp.all(jnp.isfinite(positive) & (positive > 0.0))
    is_valid &= jnp.all(jnp.isfinite(camera_position))
    factor = jnp.where(is_valid, 1.0, jnp.nan)
    terms = score_voxels(state, camera_position, focal, score)
    return jax.tree.map(lambda term: factor * term, terms)


@checked(state=a_map)
def voxel_renderability(
    state: MapState, camera_position: ArrayLike, focal: ArrayLike = 1.0, kappa: str = "box"
) -> Renderability:
    """Computes the terms of every row, as seen from one camera position; no occlusion.

    Args:
        state: the map.
        camera_position: [3] [m], world.
        focal: focal length of the camera [px], one number.
        kappa: `box`, or `one` to leave the box test out.

    Returns:
        The terms, each of shape [capacity]; `value` is 0 for rows never seen.

    Raises:
        ValueError: a position that is not [3], a focal length that is not one number, a `kappa`
            that is neither.
    """
    position = jnp.asarray(camera_position, dtype=jnp.float32)
    focal = jnp.asarray(focal, dtype=jnp.float32)
    a_point("camera_position", position)
    if focal.ndim != 0:
        raise InputError(f"focal must be one number [px], got shape {focal.shape}")
    if kappa not in ("box", "one"):
        raise InputError(f"kappa must be 'box' or 'one', got {kappa!r}")
    if not is_traced(focal) and not 0.0 < float(focal) < np.inf:
        raise InputError(f"focal must be positive and finite [px], got {float(focal)}")
    return _voxel_renderability(state, position, focal, Score(Forms(kappa)))


class TermImages(eqx.Module):
    """The terms of renderability pixel by pixel; all are 0 where a pixel shows no voxel."""

    row: Int[Array, "h w"]
    """Row of the voxel in each pixel; the map's capacity where there is none."""

    value: Float[Array, "h w"]
    """R, the product of the terms."""

    bias: Float[Array, "h w"]
    """b: from the angle to the nearest direction from which the voxel was seen."""

    noise: Float[Array, "h w"]
    """eps: the consistency of its color."""

    resolution: Float[Array, "h w"]
    """gamma: the resolution at which it was seen."""


@checked_view
@jax.jit
def term_images(
    state: MapState,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    config: ScoringConfig | None = None,
) -> TermImages:
    """Computes R and its terms for the voxel in each pixel of a view.

    Uses the pixels of `renderability_image`, and is differentiable in the same sense.
    """
    config = ScoringConfig() if config is None else config
    view = pinhole_view(camera, T_world_camera, config)
    row = rows_in_pixels(state, view, config)
    terms = score_voxels(
        voxels_of_rows(state, row), T_world_camera[:3, 3], camera.focal, config.score
    )
    factor = nan_unless_valid(camera, T_world_camera, state.voxel_size)
    image: Callable[[Array], Array] = lambda term: factor * term.reshape(row.shape)
    return TermImages(
        row, image(terms.value), image(terms.bias), image(terms.noise), image(terms.resolution)
    )


@checked_view
@jax.jit
def renderability_image(
    state: MapState,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    config: ScoringConfig | None = None,
) -> Float[Array, "h w"]:
    """Computes R of the voxel in each pixel of a view; 0 where there is none.

    The image is a depth buffer of the voxels, at most `VisibilityConfig.zbuffer_size` pixels wide
    or high, with the camera's field of view. Differentiable with respect to the pose: which voxel
    a pixel sees is held fixed, its R varies. One of `term_images`.
    """
    return term_images(state, camera, T_world_camera, config).value


@checked_view
@jax.jit
def renderability(
    state: MapState,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    config: ScoringConfig | None = None,
) -> Float[Array, ""]:
    """Rates one view: the mean of `renderability_image`, in [0, 1].

    Written for one pose; `jax.vmap` it over many:

        score = functools.partial(r3jax.renderability, map_state, camera)
        jax.vmap(score)(candidates)
    """
    config = ScoringConfig() if config is None else config
    view, position = pinhole_view(camera, T_world_camera, config), T_world_camera[:3, 3]
    mean = mean_in_pixels(state, view, position, camera.focal, config)
    return nan_unless_valid(camera, T_world_camera, state.voxel_size) * mean
