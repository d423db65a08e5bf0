"""What a view shows of the map, pixel by pixel, and what its renderability is made of.

Shape symbols: h w size of the depth buffer; N rows of the map.
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from r3jax.geometry.cameras import Camera
from r3jax.mapping.state import MapState
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.renderability import score_voxels
from r3jax.scoring.views import pinhole_view
from r3jax.scoring.visibility import candidates_of, depth_buffer
from r3jax.scoring.voxels import voxels_of

TERMS = ("bias", "noise", "resolution")
"""Factors of renderability, in the paper's order."""

LEAST = 1e-3
"""Terms are not counted lower, so that their logarithm stays finite."""


class Sight(eqx.Module):
    """One view of the map."""

    row: Int[Array, "h w"]
    """Row of the voxel in each pixel; N where there is none."""

    value: Float[Array, "h w"]
    """Its renderability from here; 0 where there is none."""

    bias: Float[Array, "h w"]
    """Factor of the angle to the nearest direction it was seen from; 0 where there is none."""

    noise: Float[Array, "h w"]
    """Factor of its color's consistency; 0 where there is none."""

    resolution: Float[Array, "h w"]
    """Factor of the distance it was seen from; 0 where there is none."""


@jax.jit
def sight(
    state: MapState, camera: Camera, T_world_camera: Float[Array, "4 4"], config: ScoringConfig
) -> Sight:
    """One view: as `renderability_image`, term by term."""
    voxels = voxels_of(state, config.delta)
    view = pinhole_view(camera, T_world_camera, config)
    buffer = depth_buffer(voxels, candidates_of(voxels, view), view, config)
    item = buffer.item.reshape(-1)
    is_hit = item < state.capacity
    seen = voxels.take(jnp.where(is_hit, item, 0), is_hit)
    terms = score_voxels(seen, T_world_camera[:3, 3], camera.focal, config.kappa)
    shaped = lambda x: x.reshape(buffer.item.shape)
    return Sight(
        row=buffer.item,
        value=shaped(terms.value),
        bias=shaped(terms.bias),
        noise=shaped(terms.noise),
        resolution=shaped(terms.resolution),
    )


@dataclass(frozen=True)
class ViewScore:
    """How well one view would render, and why not better."""

    renderability: float
    """Mean over all pixels; a pixel without a voxel counts 0."""

    coverage: float
    """Share of the pixels that show a voxel."""

    bias: float
    """Mean over the pixels that show a voxel."""

    noise: float
    """Mean over the pixels that show a voxel."""

    resolution: float
    """Mean over the pixels that show a voxel."""

    cause: str
    """What costs most: `unseen` (pixels without a voxel), `angle`, `noise` or `distance`."""


CAUSE_OF_TERM = {"bias": "angle", "noise": "noise", "resolution": "distance"}
"""What a low factor means."""


def view_score(
    state: MapState, camera: Camera, pose: np.ndarray, config: ScoringConfig
) -> ViewScore:
    """Judges one view.

    Args:
        state: the map.
        camera: of the view; its focal length in the unit that the map was made with.
        pose: `T_world_camera`, [4, 4] [audit units].
        config: range and size of the depth buffer.
    """
    seen = sight(state, camera, jnp.asarray(pose, dtype=jnp.float32), config)
    value, is_hit = np.asarray(seen.value), np.asarray(seen.row) < state.capacity
    coverage = float(is_hit.mean())
    images = {name: np.asarray(getattr(seen, name))[is_hit] for name in TERMS}
    mean = {name: float(x.mean()) if x.size else 0.0 for name, x in images.items()}
    # log R = sum of the logarithms: what each term costs adds up over the pixels that show any.
    cost = {
        CAUSE_OF_TERM[name]: -float(np.log(np.maximum(x, LEAST)).sum()) / is_hit.size
        for name, x in images.items()
    }
    cost["unseen"] = (1.0 - coverage) * -np.log(LEAST)
    return ViewScore(
        renderability=float(value.mean()),
        coverage=coverage,
        bias=mean["bias"],
        noise=mean["noise"],
        resolution=mean["resolution"],
        cause=max(cost, key=lambda name: cost[name]),
    )
