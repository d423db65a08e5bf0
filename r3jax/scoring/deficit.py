"""What renders badly: 1 - R of the visible voxels, summed by direction.

Only visible voxels, a tenth of a map as a rule, are worth the arithmetic of R. They are gathered
and scored in chunks, so that the cost follows the view and not the capacity of the table.

Shape symbols: n voxels; B bins of the panorama.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from r3jax.geometry.numerics import safe_norm
from r3jax.geometry.sphere import nearest_bin
from r3jax.mapping.state import MapState
from r3jax.scoring.config import Forms
from r3jax.scoring.terms import score_voxels
from r3jax.visibility.selection import Selection, for_selected


@functools.partial(jax.custom_jvp, nondiff_argnums=(4, 5))
def deficit_per_bin(
    voxels: MapState,
    visible: Selection,
    position: Float[Array, " 3"],
    focal: Float[Array, ""],
    forms: Forms,
    num_bins: int,
) -> Float[Array, " B"]:
    """Sum of (1 - R) over the visible voxels in each direction bin round a position.

    Differentiable with respect to everything but the choice of voxels and bins.

    Args:
        voxels: what is known.
        visible: which of them count.
        position: camera center [m].
        focal: focal length [px].
        forms: of kappa and delta.
        num_bins: bins of the Fibonacci lattice; 1 sums over all directions.
    """

    def add(
        index: Int[Array, " K"], valid: Bool[Array, " K"], total: Float[Array, " B"]
    ) -> Float[Array, " B"]:
        seen = voxels.take(index, valid)
        return total + _deficit(seen, valid, position, focal, forms, num_bins)

    return for_selected(visible, add, jnp.zeros(num_bins, dtype=jnp.float32))


@deficit_per_bin.defjvp
def _deficit_per_bin_jvp(
    forms: Forms,
    num_bins: int,
    primals: tuple[MapState, Selection, Float[Array, " 3"], Float[Array, ""]],
    tangents: tuple[Any, ...],
) -> tuple[Float[Array, " B"], Float[Array, " B"]]:
    # A loop of unknown length has no reverse mode; the dense form has, and gives the same sums.
    def dense(
        voxels: MapState, visible: Selection, position: Float[Array, " 3"], focal: Float[Array, ""]
    ) -> Float[Array, " B"]:
        return _deficit(voxels, visible.mask, position, focal, forms, num_bins)

    return jax.jvp(dense, primals, tangents)


def _deficit(
    voxels: MapState,
    visible: Bool[Array, " n"],
    position: Float[Array, " 3"],
    focal: Float[Array, ""],
    forms: Forms,
    num_bins: int,
) -> Float[Array, " B"]:
    lack = 1.0 - score_voxels(voxels, position, focal, forms).value
    # Absent voxels have R = 0: each would count as a whole voxel that renders badly.
    lack = jnp.where(visible & voxels.present, lack, 0.0)
    return sum_by_direction(voxels.center, lack, position, num_bins)


def sum_by_direction(
    points: Float[Array, "3 n"],
    weight: Float[Array, " n"],
    position: Float[Array, " 3"],
    num_bins: int,
) -> Float[Array, " B"]:
    """Sums weights into the bins in which points lie, seen from a position; 1 bin sums all."""
    if num_bins == 1:
        return jnp.sum(weight, keepdims=True)
    # The choice of the bin is piecewise constant: no derivative passes through it.
    offset = jax.lax.stop_gradient(points - position[:, None])
    direction = offset / jnp.maximum(safe_norm(offset, axis=0), 1e-6)[None, :]
    bins = nearest_bin(direction, num_bins)
    return jnp.zeros(num_bins, dtype=jnp.float32).at[bins].add(weight)
