"""How well one view of the map would render, and what its renderability is made of."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from r3jax.geometry.cameras import Camera
from r3jax.mapping.state import MapState
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.renderability import term_images

TERMS = ("bias", "noise", "resolution")
"""Factors of renderability, in the paper's order."""

LEAST = 1e-3
"""Terms are not counted lower, so that their logarithm stays finite."""


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
    seen = term_images(state, camera, jnp.asarray(pose, dtype=jnp.float32), config)
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
