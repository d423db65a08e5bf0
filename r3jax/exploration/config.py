"""Settings of the loop. Plain numbers: they go into run.json as they are."""

import math
from dataclasses import dataclass
from typing import Literal

from r3jax.forecast.goal import parse_goal
from r3jax.trace import BEYOND_RANGE, DEPTH_STEPS_PER_METRE

ClockName = Literal["wall", "model"]

MAX_CAPACITY = 1 << 27
"""Rows of a map: 5 GB."""

LARGEST_DEPTH = (BEYOND_RANGE - 1) / DEPTH_STEPS_PER_METRE
"""What lies farther is recorded as beyond the range [m]."""


def check_voxel_size(voxel_size: float, max_range: float) -> None:
    """Refuses voxels so large that a map of them tells nothing.

    Args:
        voxel_size: edge of a voxel [m].
        max_range: of the depth sensor [m].

    Raises:
        ValueError: they are larger than a fifth of the range.
    """
    if voxel_size > 0.2 * max_range:
        raise ValueError(
            f"voxel_size must be at most a fifth of the range of {max_range:g} m, got "
            f"{voxel_size:g}"
        )


@dataclass(frozen=True)
class ExplorationConfig:
    """What the loop itself decides; the policy has its own settings."""

    voxel_size: float = 0.05
    """Edge of a voxel of the map [m]."""

    num_bins: int = 64
    """Direction bins per voxel."""

    capacity: int = 1 << 17
    """Rows of the map at the start; a power of two."""

    allow_growth: bool = True
    """Double the table before it is 70 % full. If not, what finds no row is counted."""

    drop_edges: bool = True
    """Keep pixels on depth edges, whose color mixes two surfaces, out of the map."""

    cell_size: float = 0.2
    """Edge of a cell of the coarse grid [m]."""

    max_range: float = 5.0
    """Range of the depth sensor [m]."""

    body_radius: float = 0.3
    """Where the camera has been, this ball is free [m]."""

    start_radius: float = 0.5
    """The ball round the start that the operator vouches for [m]."""

    speed: float = 1.0
    """Flight speed [m/s] where the policy's motion has none; turning takes no time then."""

    clock: ClockName = "wall"
    """`wall`: measured planning and mapping. `model`: fixed costs, the same run every time."""

    num_probes: int = 16
    """Views that mean renderability is averaged over."""

    checkpoint_every: int = 1
    """Views between two stored states of the loop; the last one is always stored."""

    max_still_views: int = 100
    """So many views in a row without moving end the run: the policy is stuck."""

    until: str | None = None
    """The run ends when the forecast says so: `psnr:25` for the mean of all views of the free
    space, `psnr:20@p10` for all but the worst tenth; None: the budget alone ends it."""

    until_every: int = 5
    """Views from one look at the forecast to the next; it takes most of a second."""

    def check_scales(self) -> None:
        """Refuses lengths that do not fit together; what was recorded with them is still read.

        Raises:
            ValueError: a range beyond what depth images can hold, or voxels so large that a map of
                them tells nothing.
        """
        if self.max_range > LARGEST_DEPTH:
            raise ValueError(
                f"max_range must be at most {LARGEST_DEPTH:.1f} m, which a depth image can hold, "
                f"got {self.max_range:g}"
            )
        check_voxel_size(self.voxel_size, self.max_range)

    def __post_init__(self) -> None:
        """Refuses what cannot work."""
        if self.until is not None:
            parse_goal(self.until)
        for name in ("voxel_size", "cell_size", "max_range", "speed"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        for name in ("voxel_size", "cell_size"):
            if not 1e-3 <= getattr(self, name) <= 1e3:
                raise ValueError(
                    f"{name} must lie between 0.001 and 1000 m, got {getattr(self, name)}"
                )
        for name in (
            "num_bins", "num_probes", "checkpoint_every", "max_still_views", "until_every"
        ):  # fmt: skip
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.capacity < 2 or self.capacity & (self.capacity - 1):
            raise ValueError(f"capacity must be a power of two >= 2, got {self.capacity}")
        if self.capacity > MAX_CAPACITY:
            raise ValueError(f"capacity must be at most {MAX_CAPACITY}, got {self.capacity}")
        if self.clock not in ("wall", "model"):
            raise ValueError(f"clock must be `wall` or `model`, got {self.clock!r}")
