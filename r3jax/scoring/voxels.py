"""The voxels of a map as the closed forms want them: centers, bins, consistency, resolution.

Shape symbols: n voxels; W words of bins; N capacity of a map.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from r3jax.geometry.voxels import unpack, voxel_center
from r3jax.mapping.state import MapState


class Voxels(eqx.Module):
    """Some or all voxels of a map, ready to be scored.

    Fields are the map's own; what follows from them is computed where it is used, so that a loop
    over a few voxels does not prepare all of them.
    """

    key: UInt32[Array, "2 n"]
    """Packed voxel index."""

    visited: UInt32[Array, "W n"]
    """Direction bins."""

    count: Float[Array, " n"]
    """Observations; 0 where there is no voxel."""

    m2: Float[Array, " n"]
    """Sum of squared color deviations."""

    resolution: Float[Array, " n"]
    """Best resolution so far [px/m]."""

    size: Float[Array, ""]
    """Edge of a voxel [m]."""

    num_bins: int = eqx.field(static=True)
    """Direction bins B."""

    delta_form: str = eqx.field(static=True)
    """As in `ScoringConfig.delta`."""

    @property
    def present(self) -> Bool[Array, " n"]:
        """True where there is a voxel that was seen."""
        return self.count > 0.0

    @property
    def center(self) -> Float[Array, "3 n"]:
        """Centers [m]; meaningless where there is no voxel."""
        return voxel_center(jnp.stack(unpack(self.key[0], self.key[1])), self.size)

    @property
    def delta(self) -> Float[Array, " n"]:
        """Color consistency: 1 where nothing contradicts, 0 where the color is arbitrary."""
        return consistency(self.count, self.m2, self.delta_form)

    def take(self, index: Int[Array, " m"], valid: Bool[Array, " m"]) -> "Voxels":
        """The voxels at `index`; absent where `valid` is False."""
        return Voxels(
            key=self.key[:, index],
            visited=self.visited[:, index],
            count=jnp.where(valid, self.count[index], 0.0),
            m2=self.m2[index],
            resolution=self.resolution[index],
            size=self.size,
            num_bins=self.num_bins,
            delta_form=self.delta_form,
        )

    def center_of(self, index: Int[Array, " m"]) -> Float[Array, "3 m"]:
        """Centers of the voxels at `index` [m]."""
        low, high = self.key[0, index], self.key[1, index]
        return voxel_center(jnp.stack(unpack(low, high)), self.size)


def consistency(
    count: Float[Array, " n"], m2: Float[Array, " n"], form: str = "trace"
) -> Float[Array, " n"]:
    """delta: how consistent the colors of a voxel are, in [0, 1].

    `trace` is Algorithm 2 of arXiv 2601.07484, 1 - sqrt(2 / 1.5) sqrt(tr(M) / (n - 1));
    `pairwise` is its text, one minus the mean squared difference over pairs, which equals
    1 - 2 tr(M) / (n - 1). Both are clipped to [0, 1], and are 1 for n <= 1.
    """
    variance = m2 / jnp.maximum(count - 1.0, 1.0)
    spread = 2.0 * variance if form == "pairwise" else jnp.sqrt(2.0 / 1.5 * variance)
    return jnp.where(count > 1.0, jnp.clip(1.0 - spread, 0.0, 1.0), 1.0)


def voxels_of(state: MapState, delta: str = "trace") -> Voxels:
    """All rows of a map, in the map's order: n = N."""
    return Voxels(
        key=state.key,
        visited=state.visited,
        count=state.count,
        m2=state.m2,
        resolution=state.resolution,
        size=state.voxel_size,
        num_bins=state.num_bins,
        delta_form=delta,
    )
