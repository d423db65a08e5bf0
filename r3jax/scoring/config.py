"""Settings of every score. Numbers are traced, so a sweep over them compiles once."""

from typing import NamedTuple

import equinox as eqx
from jaxtyping import Array, Float

from r3jax.geometry.arguments import one, or_none
from r3jax.visibility.config import VisibilityConfig, as_float32


class Forms(NamedTuple):
    """Form of each term where the paper leaves a choice; fields as in `ScoringConfig`."""

    kappa: str = "box"
    delta: str = "trace"
    sample: int = 1


PAPER = Forms()
"""What the paper's equations and algorithms say."""

MOST_SAMPLED = 64
"""A view of 128 x 96 pixels then still scores some hundred of the voxels that it shows."""


class ScoringConfig(VisibilityConfig):
    """What the closed forms and the utilities leave open, beside what visibility does."""

    lambda1: Float[Array, ""] = eqx.field(default=16.0, converter=as_float32)
    """Weight of one visible unexplored cell against one voxel that renders badly. A cell of 0.2 m
    hides a surface of about 4 x 4 voxels of 5 cm; with 1 a run through a large house stays in
    the first rooms."""

    kappa: str = eqx.field(default="box", static=True)
    """`box`: 1 inside the seen directions' box, else 2. `one`: always 1."""

    delta: str = eqx.field(default="trace", static=True)
    """`runs`: the paper's Algorithm 2. `pairwise`: its text, 1 - 2 tr(M) / (n - 1)."""

    panorama_bins: int = eqx.field(default=526, static=True)
    """Directions of the panorama; 526 are 10 degrees apart."""

    sample: int = eqx.field(default=1, static=True)
    """Score one of so many visible voxels, and count it so many times; 1: every one, exactly.
    Which voxels stay is a regular pattern, so that every surface keeps its share. What hides
    what, and the unexplored cells, are never sampled."""

    @property
    def forms(self) -> Forms:
        """Forms of the terms of R."""
        return Forms(self.kappa, self.delta, self.sample)

    def __check_init__(self) -> None:
        """Refuses settings that no formula knows."""
        if self.kappa not in ("box", "one"):
            raise ValueError(f"kappa must be 'box' or 'one', got {self.kappa!r}")
        if self.delta not in ("trace", "pairwise"):
            raise ValueError(f"delta must be 'trace' or 'pairwise', got {self.delta!r}")
        if not 1 <= self.sample <= MOST_SAMPLED:
            raise ValueError(f"sample must lie between 1 and {MOST_SAMPLED}, got {self.sample}")


scoring_settings = or_none(one(ScoringConfig, "None: its defaults"))
