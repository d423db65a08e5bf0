"""The coarse grid: free, occupied and unexplored space, for safe travel and for exploration.

Shape symbols: X Y Z cells along the axes.
"""

import equinox as eqx
from jaxtyping import Array, Bool, Float

FREE_LOG_ODDS = -1.3862944
"""A cell is free below this: p = 0.2."""

OCCUPIED_LOG_ODDS = 1.3862944
"""A cell is occupied above this: p = 0.8."""


class OccupancyGrid(eqx.Module):
    """Log-odds of occupancy over an axis-aligned box."""

    log_odds: Float[Array, "X Y Z"]
    """Log-odds that the cell holds matter, clipped to +-4.5; 0: never touched."""

    origin: Float[Array, " 3"]
    """Lower corner of cell (0, 0, 0) in the world [m]."""

    cell_size: Float[Array, ""]
    """Edge of a cell [m]."""

    @property
    def free(self) -> Bool[Array, "X Y Z"]:
        """Cells known to be free."""
        return self.log_odds < FREE_LOG_ODDS

    @property
    def occupied(self) -> Bool[Array, "X Y Z"]:
        """Cells known to hold matter."""
        return self.log_odds > OCCUPIED_LOG_ODDS

    @property
    def unexplored(self) -> Bool[Array, "X Y Z"]:
        """Cells that are neither."""
        return ~(self.free | self.occupied)
