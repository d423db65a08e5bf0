"""Settings of visibility. Numbers are traced, so a sweep over them compiles once."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from r3jax.errors import InputError


def as_float32(value: float | Array) -> Float[Array, ""]:
    """Converts a setting, so that Python numbers and arrays compile to the same program."""
    return jnp.asarray(value, dtype=jnp.float32)


class VisibilityConfig(eqx.Module):
    """How far a camera sees, and how fine the depth buffers are."""

    max_range: Float[Array, ""] = eqx.field(default=5.0, converter=as_float32)
    """Range of the sensor: nothing farther away counts as visible [m]."""

    tolerance: Float[Array, ""] = eqx.field(default=2.0, converter=as_float32)
    """A voxel this far behind the depth buffer, across the surface in it, still counts as
    visible [voxels]. Centers lie up to 1.7 voxels apart along a ray that crosses a single
    surface; 2 agrees best with ray casting."""

    zbuffer_size: int = eqx.field(default=128, static=True)
    """Longest side of the pinhole depth buffer [px]; never more than the image's."""

    panorama_size: int = eqx.field(default=256, static=True)
    """Side of the octahedral depth buffer round a position [px]; a power of two."""

    def __check_init__(self) -> None:
        """Refuses a side that the octahedral map cannot have."""
        # Powers of two halve exactly, so that the borders of every level of the pyramid wrap alike.
        if self.panorama_size < 2 or self.panorama_size & (self.panorama_size - 1):
            raise InputError(f"panorama_size must be a power of two, got {self.panorama_size}")
