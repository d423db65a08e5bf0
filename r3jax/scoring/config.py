"""Settings of the scores. Numbers are traced, so that a sweep over them compiles once."""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from r3jax.errors import InputError
from r3jax.geometry.arguments import a_camera, a_pose, checked, one, or_none
from r3jax.geometry.cameras import is_traced
from r3jax.kernels.calls import Forms
from r3jax.mapping.state import a_map
from r3jax.visibility.views import VisibilityConfig, as_float32

PAPER = Forms()
"""The paper's equations and algorithms."""


class ScoringConfig(VisibilityConfig):
    """Settings of the closed forms and the utilities, beside those of visibility."""

    lambda1: Float[Array, ""] = eqx.field(default=16.0, converter=as_float32)
    """Weight of a visible unexplored cell relative to a voxel with R = 0. A cell of 0.2 m hides a
    surface of about 4 x 4 voxels of 5 cm; with a weight of 1, runs through a large house do not
    leave the first rooms."""

    kappa: str = eqx.field(default="box", static=True)
    """`box`: 1 inside the bounding box of the seen directions, else 2. `one`: always 1."""

    delta: str = eqx.field(default="trace", static=True)
    """`trace`: the paper's Algorithm 2. `pairwise`: its text, 1 - 2 tr(M) / (n - 1)."""

    panorama_bins: int = eqx.field(default=526, static=True)
    """Number of directions of the panorama; 526 are 10 degrees apart."""

    @property
    def forms(self) -> Forms:
        """Forms of the terms of R."""
        return Forms(self.kappa, self.delta)

    def __check_init__(self) -> None:
        """Refuses invalid settings."""
        if self.kappa not in ("box", "one"):
            raise InputError(f"kappa must be 'box' or 'one', got {self.kappa!r}")
        if self.delta not in ("trace", "pairwise"):
            raise InputError(f"delta must be 'trace' or 'pairwise', got {self.delta!r}")
        # A traced weight has no value to check.
        if not is_traced(self.lambda1) and not np.isfinite(self.lambda1).all():
            raise InputError(f"lambda1 (--lambda1) must be finite in float32, got {self.lambda1}")


RETIRED = {"sample": "it was off, and no table rests on it; commit 4fa1d20 has it"}
"""Removed settings: why they were removed, and the commit with their code."""


def scoring_config_of(settings: dict[str, Any]) -> ScoringConfig:
    """Makes the settings from those of a record or a command.

    Raises:
        ValueError: no setting has one of these names (any more), or a value is impossible.
    """
    for name in settings:
        if name in RETIRED:
            raise InputError(f"setting scoring.{name} has left the package: {RETIRED[name]}")
    return ScoringConfig(**settings)


scoring_settings = or_none(one(ScoringConfig, "None: its defaults"))

checked_view = checked(state=a_map, camera=a_camera, T_world_camera=a_pose, config=scoring_settings)
"""Decorates a score of one view of a map with checks of its arguments."""
