"""Settings of every score. Numbers are traced, so a sweep over them compiles once."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


def _float32(value: float | Array) -> Float[Array, ""]:
    return jnp.asarray(value, dtype=jnp.float32)


class ScoringConfig(eqx.Module):
    """What the closed forms, the visibility and the utilities leave open."""

    lambda1: Float[Array, ""] = eqx.field(default=1.0, converter=_float32)
    """Weight of one visible unexplored cell against one voxel that renders badly."""

    max_range: Float[Array, ""] = eqx.field(default=5.0, converter=_float32)
    """Nothing farther away counts as visible [m]: the sensor's range."""

    kappa: str = eqx.field(default="box", static=True)
    """`box`: 1 inside the seen directions' box, else 2. `one`: always 1."""

    downscale: int = eqx.field(default=4, static=True)
    """The pinhole z-buffer has 1/downscale of the camera's width and height."""

    panorama_bins: int = eqx.field(default=526, static=True)
    """Directions of the panorama; 526 are 10 degrees apart."""
