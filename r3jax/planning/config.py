"""Settings that all policies share."""

import math
from dataclasses import dataclass, field

from r3jax.errors import InputError
from r3jax.planning.robot.motion import Motion
from r3jax.scoring.config import ScoringConfig

MAX_CANDIDATES = 10_000
"""Maximum number of candidates: 100 times the paper's. More take minutes per decision."""

FORMER_SETTINGS = {
    "num_standpoints": 16, "horizon": 4, "num_spread": 40, "beam": 4, "branching": 6,
    "view_seconds": 4.0,
}  # fmt: skip
"""Settings of a single policy that older runs of all policies recorded, with their former
defaults."""


@dataclass(frozen=True)
class PlannerConfig:
    """Settings for drawing and weighing candidates. Defaults are the paper's where it gives one.

    Raises:
        ValueError: an invalid setting.
    """

    num_candidates: int = 100
    """Number of poses (or positions) scored per decision."""

    radius: float = 0.5
    """Local candidates lie within this distance of the robot [m]."""

    num_frontier: int = 30
    """Number of candidates that view the reachable frontier instead of being local.

    With local candidates only, a robot stays in a room that is complete: all candidates within half
    a meter are equally well known, and none of them shows the door. 30 of 100 is the share of
    Active-GS, whose candidates the paper adopts; 0 is the paper's literal text. All candidates
    compete on equal terms, path length included."""

    lambda2: float = 0.5
    """lambda2: weight of a candidate's share of the path lengths relative to its share of the
    utility."""

    safety_margin: float = 0.3
    """Safety margin: distance of a path's cells from everything not known to be free [m]."""

    refine: int = 0
    """Number of best candidates of `r3` and `r3-pano` that are refined by gradient ascent of the
    smooth utility (`planning.refine`); 0: none."""

    refine_radius: float = 0.4
    """Maximum displacement of a refined view along each axis [m]; 0: only its direction is
    refined."""

    motion: Motion = field(default_factory=Motion)
    """The robot: its allowed heights and viewing directions, its body and its speed."""

    scoring: ScoringConfig = field(default_factory=ScoringConfig)
    """Settings of the utilities, lambda1 among them."""

    def __post_init__(self) -> None:
        """Refuses invalid settings."""
        # Refused here, where the error can name the setting.
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
        # An infinite lambda2 times a path of length 0 would be NaN.
        for name in ("radius", "refine_radius", "lambda2", "safety_margin"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise InputError(f"{name} must be a finite number >= 0, got {value}")
