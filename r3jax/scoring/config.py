"""Settings of every score. Numbers are traced, so a sweep over them compiles once."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from r3jax.arguments import one, or_none


def _float32(value: float | Array) -> Float[Array, ""]:
    return jnp.asarray(value, dtype=jnp.float32)


class ScoringConfig(eqx.Module):
    """What the closed forms, the visibility and the utilities leave open."""

    lambda1: Float[Array, ""] = eqx.field(default=16.0, converter=_float32)
    """Weight of one visible unexplored cell against one voxel that renders badly. A cell of 0.2 m
    hides a surface of about 4 x 4 voxels of 5 cm; with 1 a run through a large house stays in
    the first rooms."""

    max_range: Float[Array, ""] = eqx.field(default=5.0, converter=_float32)
    """Nothing farther away counts as visible [m]: the sensor's range."""

    tolerance: Float[Array, ""] = eqx.field(default=2.0, converter=_float32)
    """A voxel this far behind the depth buffer, across the surface in it, still counts as
    visible [voxels]. Centers lie up to 1.7 voxels apart along a ray that crosses a single
    surface; 2 agrees best with ray casting."""

    kappa: str = eqx.field(default="box", static=True)
    """`box`: 1 inside the seen directions' box, else 2. `one`: always 1."""

    delta: str = eqx.field(default="trace", static=True)
    """`trace`: the paper's Algorithm 2. `pairwise`: its text, 1 - 2 tr(M) / (n - 1)."""

    zbuffer_size: int = eqx.field(default=128, static=True)
    """Longest side of the pinhole depth buffer [px]; never more than the image's."""

    panorama_size: int = eqx.field(default=256, static=True)
    """Side of the octahedral depth buffer round a position [px]; a power of two."""

    panorama_bins: int = eqx.field(default=526, static=True)
    """Directions of the panorama; 526 are 10 degrees apart."""

    def __check_init__(self) -> None:
        """Refuses settings that no formula knows."""
        if self.kappa not in ("box", "one"):
            raise ValueError(f"kappa must be 'box' or 'one', got {self.kappa!r}")
        if self.delta not in ("trace", "pairwise"):
            raise ValueError(f"delta must be 'trace' or 'pairwise', got {self.delta!r}")
        if self.panorama_size < 2 or self.panorama_size & (self.panorama_size - 1):
            raise ValueError(f"panorama_size must be a power of two, got {self.panorama_size}")


scoring_settings = or_none(one(ScoringConfig, "None: its defaults"))
