"""Settings of the loop. Plain numbers: they go into run.json as they are."""

import math
from dataclasses import dataclass
from typing import Literal

from r3jax.mapping.config import MappingConfig
from r3jax.trace import BEYOND_RANGE, DEPTH_STEPS_PER_METRE

ClockName = Literal["wall", "model"]

# One step less: the largest stored value means "beyond the range", not a depth.
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
class ExplorationConfig(MappingConfig):
    """What the loop itself decides, mapping included; the policy has its own settings."""

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
    """Goal that ends the run, as text (see `apps.forecast.stopping`): `psnr:25` for the mean of all
    views of the free space, `psnr:20@p10` for all but the worst tenth; None: the budget alone ends
    it."""

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
        super().__post_init__()
        # Written so that NaN fails, too: it would make every flight time and the clock NaN.
        if not 0.0 < self.speed < math.inf:
            raise ValueError(f"speed must be positive, got {self.speed}")
        # Two of them divide the number of views: a zero would fail a run after its first view.
        for name in ("num_probes", "checkpoint_every", "max_still_views", "until_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.clock not in ("wall", "model"):
            raise ValueError(f"clock must be `wall` or `model`, got {self.clock!r}")
