"""Settings that all policies share."""

import math
from dataclasses import dataclass, field

from r3jax.errors import InputError
from r3jax.planning.robot.motion import Motion
from r3jax.scoring.config import ScoringConfig

MAX_CANDIDATES = 10_000
"""A hundred times the paper's; more take minutes to draw and to score at every decision."""

FORMER_SETTINGS = {
    "num_standpoints": 16, "horizon": 4, "num_spread": 40, "beam": 4, "branching": 6,
    "view_seconds": 4.0,
}  # fmt: skip
"""Settings of one policy that older runs of all policies recorded, with their defaults then."""


@dataclass(frozen=True)
class PlannerConfig:
    """How candidates are drawn and weighed. The defaults are the paper's where it has one.

    Raises:
        ValueError: a setting that no decision could be made with.
    """

    num_candidates: int = 100
    """Poses (or positions) that are scored per decision."""

    radius: float = 0.5
    """Local candidates lie within this distance of the robot [m]."""

    num_frontier: int = 30
    """How many of the candidates are aimed at the reachable frontier instead of being local.

    Local candidates alone keep the robot in a room that is done: whatever lies half a meter
    away looks as well known as the rest, and no utility tells it that there is a door behind
    its back. 30 of 100 is the share of Active-GS, whose candidates the paper takes over; 0 is
    the paper's text to the letter. They compete on equal terms, path length included."""

    lambda2: float = 0.5
    """Weight of a candidate's share of the path lengths against its share of the utility."""

    safety_margin: float = 0.3
    """A path keeps its cells' centers this far from anything not known to be free [m]."""

    refine: int = 0
    """How many of the best candidates of `r3` and `r3-pano` ascend the gradient of the smooth
    utility (`planning.refine`); 0: none."""

    refine_radius: float = 0.4
    """A climb ends at this distance along each axis [m]; 0: it turns the view and no more."""

    motion: Motion = field(default_factory=Motion)
    """The robot: where it may be, how it may look and how fast it goes."""

    scoring: ScoringConfig = field(default_factory=ScoringConfig)
    """Settings of the utilities, lambda1 among them."""

    def __post_init__(self) -> None:
        """Refuses values that would fail later, and says which."""
        # Refused here, where the setting still has a name, not in a shape deep in a kernel.
        if not 1 <= self.num_candidates <= MAX_CANDIDATES:
            raise InputError(
                f"num_candidates must lie between 1 and {MAX_CANDIDATES}, got {self.num_candidates}"
            )
        if not 0 <= self.num_frontier <= self.num_candidates:
            raise InputError(
                f"num_frontier must lie between 0 and num_candidates ({self.num_candidates}), "
                f"got {self.num_frontier}"
            )
        if not 0 <= self.refine <= self.num_candidates:
            raise InputError(
                f"refine must lie between 0 and num_candidates ({self.num_candidates}), "
                f"got {self.refine}"
            )
        # An infinite lambda2, times a path of no length, would be NaN.
        for name in ("radius", "refine_radius", "lambda2", "safety_margin"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise InputError(f"{name} must be a finite number >= 0, got {value}")
