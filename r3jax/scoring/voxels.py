"""The voxels of a map as the closed forms want them: centers, bins, consistency, resolution.

Shape symbols: n voxels; W words of bins; N capacity of a map.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from r3jax.geometry.voxels import unpack, voxel_center
from r3jax.mapping.state import MapState


class Voxels(eqx.Module):
    """Some or all voxels of a map, ready to be scored."""

    center: Float[Array, "3 n"]
    """Centers [m]; meaningless where `present` is False."""

    visited: UInt32[Array, "W n"]
    """Direction bins, as in `MapState`."""

    delta: Float[Array, " n"]
    """Color consistency: 1 where nothing contradicts, 0 where the color is arbitrary."""

    resolution: Float[Array, " n"]
    """Best resolution so far [px/m]."""

    present: Bool[Array, " n"]
    """True where there is a voxel that was seen."""

    size: Float[Array, ""]
    """Edge of a voxel [m]."""

    num_bins: int = eqx.field(static=True)
    """Direction bins B."""

    def take(self, index: Int[Array, " m"], valid: Bool[Array, " m"]) -> "Voxels":
        """The voxels at `index`; absent where `valid` is False."""
        return Voxels(
            center=self.center[:, index],
            visited=self.visited[:, index],
            delta=self.delta[index],
            resolution=self.resolution[index],
            present=valid & self.present[index],
            size=self.size,
            num_bins=self.num_bins,
        )


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
    x, y, z = unpack(state.key[0], state.key[1])
    return Voxels(
        center=jnp.stack([voxel_center(axis, state.voxel_size) for axis in (x, y, z)]),
        visited=state.visited,
        delta=consistency(state.count, state.m2, delta),
        resolution=state.resolution,
        present=state.occupied & (state.count > 0.0),
        size=state.voxel_size,
        num_bins=state.num_bins,
    )
