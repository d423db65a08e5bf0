"""Renderability: how well a voxel, and so a view, could be rendered; in closed form.

    R = bias x noise x resolution        (arXiv 2601.07484)

Shape symbols: n voxels; N capacity of the map; h w size of the depth buffer.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from r3jax.geometry.arguments import a_camera, a_point, a_pose, checked
from r3jax.geometry.cameras import Camera, is_traced, sound
from r3jax.geometry.numerics import safe_norm, safe_power
from r3jax.mapping.state import MapState, a_map
from r3jax.scoring.config import PAPER, Forms, ScoringConfig, scoring_settings
from r3jax.scoring.directions import seen_directions
from r3jax.visibility.depth_buffer import voxels_in_pixels
from r3jax.visibility.selection import for_selected, select
from r3jax.visibility.views import pinhole_view


class Renderability(eqx.Module):
    """The terms of one query, per voxel."""

    kappa: Float[Array, " n"]
    """1 between the seen directions, 2 outside their box."""

    bias: Float[Array, " n"]
    """b = cos(theta)^kappa, theta the angle to the nearest seen direction."""

    delta: Float[Array, " n"]
    """Color consistency of the observations."""

    noise: Float[Array, " n"]
    """eps = delta^(kappa (1 - b)): noise hurts where the view must interpolate."""

    resolution: Float[Array, " n"]
    """gamma = min(1, rho_max / rho)^(1 - delta b), rho = focal / distance."""

    value: Float[Array, " n"]
    """R = b eps gamma, in [0, 1]; 0 for voxels never seen."""


def consistency(
    count: Float[Array, " n"], m2: Float[Array, " n"], form: str = "trace"
) -> Float[Array, " n"]:
    """delta: how consistent the colors of a voxel are, in [0, 1].

    `trace` is Algorithm 2 of arXiv 2601.07484, 1 - sqrt(2 / 1.5) sqrt(tr(M) / (n - 1));
    `pairwise` is its text, one minus the mean squared difference over pairs, which equals
    1 - 2 tr(M) / (n - 1). Both are clipped to [0, 1], and are 1 for n <= 1.
    """
    # The unbiased estimate; the floor only keeps a first observation from dividing by zero.
    variance = m2 / jnp.maximum(count - 1.0, 1.0)
    spread = 2.0 * variance if form == "pairwise" else jnp.sqrt(2.0 / 1.5 * variance)
    return jnp.where(count > 1.0, jnp.clip(1.0 - spread, 0.0, 1.0), 1.0)


def score_voxels(
    voxels: MapState,
    camera_position: Float[Array, " 3"],
    focal: Float[Array, ""],
    forms: Forms = PAPER,
) -> Renderability:
    """The terms of every voxel as seen from one camera position.

    Args:
        voxels: what is known of them.
        camera_position: center of the camera that asks [m].
        focal: its focal length [px], in the unit used when the map was made.
        forms: of kappa and delta.
    """
    delta = consistency(voxels.count, voxels.m2, forms.delta)
    # From the voxel to the camera, as the visited bins were recorded.
    offset = camera_position[:, None] - voxels.center
    distance = jnp.maximum(safe_norm(offset, axis=0), 1e-6)
    direction = offset / distance[None, :]
    cosine, inside = seen_directions(voxels.visited, direction, voxels.num_bins)
    is_one = (inside > 0.0) | (forms.kappa == "one")
    kappa_value = jnp.where(is_one, 1.0, 2.0)
    # kappa is 1 or 2: a product will do, and no power whose gradient could fail at 0.
    bias = jnp.where(is_one, cosine, cosine * cosine)
    # delta may be exactly 0, where the gradient of a plain power is infinite or NaN.
    noise = safe_power(delta, kappa_value * (1.0 - bias))
    # rho_max / rho with rho = f / d: to come closer than ever costs, to stay farther does not.
    ratio = jnp.minimum(voxels.resolution * distance / focal, 1.0)
    resolution = safe_power(ratio, 1.0 - delta * bias)
    blank: Callable[[Array], Array] = lambda term: jnp.where(voxels.present, term, 0.0)
    return Renderability(
        kappa=kappa_value,
        bias=blank(bias),
        delta=delta,
        noise=blank(noise),
        resolution=blank(resolution),
        value=blank(bias * noise * resolution),
    )


@functools.partial(jax.custom_jvp, nondiff_argnums=(3,))
def _score_present(
    voxels: MapState, camera_position: Float[Array, " 3"], focal: Float[Array, ""], forms: Forms
) -> Renderability:
    """`score_voxels`, at a cost that follows the voxels present and not the capacity."""
    num = voxels.present.shape[0]

    def score(
        index: Int[Array, " K"], valid: Bool[Array, " K"], terms: Renderability
    ) -> Renderability:
        part = score_voxels(voxels.take(index, valid), camera_position, focal, forms)
        target = jnp.where(valid, index, num)
        return jax.tree.map(lambda all, new: all.at[target].set(new, mode="drop"), terms, part)

    # What absent rows keep: kappa 2, delta 1, and 0 for R and its factors.
    zeros, ones = jnp.zeros(num), jnp.ones(num)
    return for_selected(
        select(voxels.present), score, Renderability(2.0 * ones, zeros, ones, zeros, zeros, zeros)
    )


@_score_present.defjvp
def _score_present_jvp(
    forms: Forms,
    primals: tuple[MapState, Float[Array, " 3"], Float[Array, ""]],
    tangents: tuple[Any, ...],
) -> tuple[Renderability, Renderability]:
    # A loop of unknown length has no reverse mode; the dense form has.
    return jax.jvp(functools.partial(score_voxels, forms=forms), primals, tangents)


@functools.partial(jax.jit, static_argnames="forms")
def _voxel_renderability(
    state: MapState, camera_position: Float[Array, " 3"], focal: Float[Array, ""], forms: Forms
) -> Renderability:
    terms = _score_present(state, camera_position, focal, forms)
    positive = jnp.stack([focal, state.voxel_size])
    is_sound = jnp.all(jnp.isfinite(camera_position)) & jnp.all(jnp.isfinite(positive))
    factor = jnp.where(is_sound & jnp.all(positive > 0.0), 1.0, jnp.nan)
    return jax.tree.map(lambda term: factor * term, terms)


@checked(state=a_map)
def voxel_renderability(
    state: MapState, camera_position: ArrayLike, focal: ArrayLike = 1.0, kappa: str = "box"
) -> Renderability:
    """The terms of every row of the map, as seen from one camera position; no occlusion.

    Args:
        state: the map.
        camera_position: [3] [m], world.
        focal: focal length of the camera that asks [px], one number.
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
        raise ValueError(f"focal must be one number [px], got shape {focal.shape}")
    if kappa not in ("box", "one"):
        raise ValueError(f"kappa must be 'box' or 'one', got {kappa!r}")
    if not is_traced(focal) and not 0.0 < float(focal) < np.inf:
        raise ValueError(f"focal must be positive and finite [px], got {float(focal)}")
    return _voxel_renderability(state, position, focal, Forms(kappa))


class TermImages(eqx.Module):
    """What one view shows of the map, pixel by pixel; every term is 0 where it shows nothing."""

    row: Int[Array, "h w"]
    """Row of the voxel that a pixel sees; the map's capacity where it sees none."""

    value: Float[Array, "h w"]
    """R, the product of the terms."""

    bias: Float[Array, "h w"]
    """b: the angle to the nearest direction that the voxel was seen from."""

    noise: Float[Array, "h w"]
    """eps: the consistency of its color."""

    resolution: Float[Array, "h w"]
    """gamma: the sharpness that it was seen with."""


@checked(state=a_map, camera=a_camera, T_world_camera=a_pose, config=scoring_settings)
@jax.jit
def term_images(
    state: MapState,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    config: ScoringConfig | None = None,
) -> TermImages:
    """R and its terms, of the voxel that each pixel of one view sees.

    In the pixels of `renderability_image`, and differentiable as it is.
    """
    config = ScoringConfig() if config is None else config
    view = pinhole_view(camera, T_world_camera, config)
    seen, row = voxels_in_pixels(state, view, config)
    terms = score_voxels(seen, T_world_camera[:3, 3], camera.focal, config.forms)
    factor = sound(camera, T_world_camera, state.voxel_size)
    image: Callable[[Array], Array] = lambda term: factor * term.reshape(row.shape)
    return TermImages(
        row, image(terms.value), image(terms.bias), image(terms.noise), image(terms.resolution)
    )


@checked(state=a_map, camera=a_camera, T_world_camera=a_pose, config=scoring_settings)
@jax.jit
def renderability_image(
    state: MapState,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    config: ScoringConfig | None = None,
) -> Float[Array, "h w"]:
    """R of the voxel that each pixel of one view sees; 0 where it sees none.

    The image is a depth buffer of the voxels, at most `config.zbuffer_size` pixels wide or
    high, with the camera's field of view. Differentiable with respect to the pose: which voxel
    a pixel sees is held fixed, its R varies. One of `term_images`.
    """
    return term_images(state, camera, T_world_camera, config).value


@checked(state=a_map, camera=a_camera, T_world_camera=a_pose, config=scoring_settings)
@jax.jit
def renderability(
    state: MapState,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    config: ScoringConfig | None = None,
) -> Float[Array, ""]:
    """How well one view could be rendered: the mean of `renderability_image`, in [0, 1].

    Written for one pose; `jax.vmap` it over many:

        score = functools.partial(r3jax.renderability, map_state, camera)
        jax.vmap(score)(candidates)
    """
    return jnp.mean(renderability_image(state, camera, T_world_camera, config))
