"""Explains the utility of a view: divides it among four causes.

    U = lambda1 U_G + sum of (1 - R),    R = bias x noise x resolution        (arXiv 2601.07484)

The first term is space that was never seen. The deficit of a visible voxel, 1 - R, is divided among
the factors of R in proportion to their logarithms, which add up to the logarithm of R. So a factor
of 1 gets nothing, a factor of 0 gets everything, and the order of the factors makes no difference.
The division is not in the paper.

Shape symbols: n voxels; F factors; N capacity of the map; X Y Z cells of the grid.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from r3jax.geometry.arguments import a_camera, a_pose, checked
from r3jax.geometry.cameras import Camera, nan_unless_valid
from r3jax.geometry.selection import for_selected
from r3jax.mapping.occupancy import OccupancyGrid, a_grid, cells_of
from r3jax.mapping.seen import seen_in_view
from r3jax.mapping.state import MapState, a_map
from r3jax.scoring.config import Score, ScoringConfig, scoring_settings
from r3jax.scoring.terms import deficits_of, score_voxels
from r3jax.visibility.views import pinhole_view

CAUSES = ("never seen", "too oblique", "inconsistent", "too far")
"""The causes: unexplored cells, then the factors bias, noise and resolution."""

_LEAST = float(jnp.finfo(jnp.float32).tiny)
"""Smaller factors count as 0: some devices flush them to zero before taking the logarithm."""

_Sums = tuple[Float[Array, "3 N"], Float[Array, " 3"]]
"""Shares of every row, and their totals."""


class Explanation(eqx.Module):
    """The utility of a view (`ViewUtility`) by cause, in the order of `CAUSES`."""

    totals: Float[Array, " 4"]
    """Shares of the whole view; they sum to its utility lambda1 U_G + U_R."""

    shares: Float[Array, "3 N"]
    """Shares of each row of the map: too oblique, inconsistent, too far. They sum to 1 - R for
    visible rows, and are 0 for all others."""

    visible: Bool[Array, " N"]
    """Rows that the view sees."""

    cells: Bool[Array, "X Y Z"]
    """Unexplored cells that the view sees; each adds lambda1 to the first cause."""


@checked(state=a_map, grid=a_grid, camera=a_camera, T_world_camera=a_pose, config=scoring_settings)
@jax.jit
def explain_view(
    state: MapState,
    grid: OccupancyGrid,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    config: ScoringConfig | None = None,
) -> Explanation:
    """Divides the utility of one view among its causes, for every voxel and in total.

    It sees what `view_utility` of the same view sees. A voxel observed only once is never called
    inconsistent: there is nothing to compare it with.

    Args:
        state: the map.
        grid: whose unexplored cells count; planners count explorable ones only.
        camera: of the view, its focal length in the unit that the map was made with.
        T_world_camera: the view.
        config: lambda1, range, and settings of the closed forms.
    """
    config = ScoringConfig() if config is None else config
    view = pinhole_view(camera, T_world_camera, config)
    # The steps of `view_utility`, one by one: the parts must sum to its total.
    shown, unseen = seen_in_view(state, cells_of(grid), view, config)
    position = T_world_camera[:3, 3]
    shares, rendering = _divide_visible(state, shown, position, camera.focal, config.score)
    exploration = config.lambda1 * jnp.sum(unseen, dtype=jnp.float32)
    factor = nan_unless_valid(camera, T_world_camera, state.voxel_size, grid.cell_size)
    return Explanation(
        totals=factor * jnp.concatenate([exploration[None], rendering]),
        shares=factor * shares,
        visible=shown,
        cells=unseen.reshape(grid.log_odds.shape),
    )


def _divide_visible(
    voxels: MapState,
    visible: Bool[Array, " N"],
    position: Float[Array, " 3"],
    focal: Float[Array, ""],
    score: Score,
) -> _Sums:
    """Attributes the deficits of the visible voxels to causes, summed in the order of U_R."""
    num = voxels.capacity

    def add(index: Int[Array, " K"], valid: Bool[Array, " K"], sums: _Sums) -> _Sums:
        shares, totals = sums
        some = voxels.take(index, valid)
        terms = score_voxels(some, position, focal, score)
        factors = jnp.stack([terms.bias, terms.noise, terms.resolution])
        deficit = deficits_of(some, terms, score)
        part = jnp.where(valid[None, :], attribute_deficit(deficit, factors), 0.0)
        target = jnp.where(valid, index, num)  # out of range, so dropped
        return shares.at[:, target].set(part, mode="drop"), totals + jnp.sum(part, axis=1)

    start = jnp.zeros((3, num), dtype=jnp.float32), jnp.zeros(3, dtype=jnp.float32)
    return for_selected(visible, add, start)


def attribute_deficit(
    deficit: Float[Array, " n"], factors: Float[Array, "F n"]
) -> Float[Array, "F n"]:
    """Attributes the deficit 1 - prod(f) to the factors, in proportion to -log f.

    share of f = deficit log(f) / sum of the logarithms. Factors of 0 share the deficit equally, and
    the others get nothing; so do factors that are all 1.

    Args:
        deficit: 1 - the product of the factors, or another function of them.
        factors: each in [0, 1].

    Returns:
        Shares >= 0 that sum to `deficit`; all 0 where it is 0.
    """
    is_zero = factors < _LEAST
    cost = -jnp.log(jnp.where(is_zero, 1.0, factors))
    weight = jnp.where(jnp.any(is_zero, axis=0)[None, :], is_zero.astype(factors.dtype), cost)
    total = jnp.sum(weight, axis=0)
    # Where all factors are 1 their product leaves no deficit; another function of them may.
    weight = jnp.where(total > 0.0, weight, 1.0)
    return weight * (deficit / jnp.where(total > 0.0, total, float(len(factors))))[None, :]
