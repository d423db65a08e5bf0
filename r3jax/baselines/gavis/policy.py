"""GAVIS: views whose colors are least known, because no photo shows what they show from there.

    utility = mean over the rays of a view of H(u)      (`gavis.rays`, `gavis.visibility`)
    total   = utility / sum of utilities - lambda2 * path / sum of paths

The paper's: visibility that depends on the direction, from all photos and what hides what in them;
particles that stand for unexplored space and were never seen; a view's worth is the information
that it brings, which is the entropy of its rays, as the noise of any photo is alike.
Our reading: surface elements are the map's voxels, opaque, and photos its direction bins; the
particles are the unexplored cells of the coarse grid, of an opacity of their own in place of 0,
by which a ray's color may come from them; colors that no photo shows are spread alike everywhere;
kappa, that opacity and that spread, whose values we could not read; candidates, paths and their
weight are those of Ours. No radiance field is kept.

Shape symbols: C candidates.
"""

import math
from dataclasses import dataclass, field

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from r3jax.baselines.gavis.rays import Beliefs, ends_of_rays, entropy_of_views
from r3jax.planning.candidates import Candidates
from r3jax.planning.config import PlannerConfig
from r3jax.planning.greedy import GreedyPolicy
from r3jax.planning.policy import Situation
from r3jax.scoring.pixels import score_pixels
from r3jax.visibility.views import pinhole_view


@dataclass(frozen=True)
class GavisConfig(PlannerConfig):
    """Settings of `gavis`; of the scoring it takes the range and the depth buffer."""

    kappa: float = 4.0
    """Fall of visibility with the angle to a photo's direction: 0.31 at 45 degrees, 0.02 at 90.
    0: seen from one side, a voxel is known from all (the paper's isotropic ablation)."""

    cell_opacity: float = 0.1
    """Probability that an unexplored cell stops a ray; 0: unexplored space is empty (the paper's
    ablation without virtual particles)."""

    color_entropy: float = 6.9
    """Entropy of a color that no photo shows, over that of a photo's noise [nats]: 3 ln 10, a
    standard deviation ten times as large in each channel."""

    def __post_init__(self) -> None:
        """Refuses values that would fail later, and says which."""
        super().__post_init__()
        for name in ("kappa", "color_entropy"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} must be a finite number >= 0, got {value}")
        if not 0.0 <= self.cell_opacity <= 1.0:
            raise ValueError(f"cell_opacity must lie in [0, 1], got {self.cell_opacity}")

    def beliefs(self) -> Beliefs:
        """The three of them, traced, so that a sweep compiles once."""
        numbers = (self.kappa, self.cell_opacity, self.color_entropy)
        return Beliefs(*(jnp.asarray(number, dtype=jnp.float32) for number in numbers))


@dataclass(frozen=True)
class Gavis(GreedyPolicy):
    """Views whose rays have the greatest entropy, by a visibility that depends on the direction."""

    config: GavisConfig = field(default_factory=GavisConfig)

    name = "gavis"
    source = "GAVIS, CVPR 2026, arXiv 2605.30342"
    Config = GavisConfig

    def score(
        self, situation: Situation, candidates: Candidates, *, key: Array
    ) -> tuple[Candidates, dict[str, np.ndarray]]:
        """The mean entropy of the rays of every view."""
        del key
        state, grid, scoring = situation.map_state, situation.scoring_grid, self.config.scoring
        poses = candidates.poses_on_device()
        ends = score_pixels(
            ends_of_rays, state, grid, situation.camera, poses, scoring, state.visited
        )
        utility = entropy_of_views(
            ends,
            grid,
            pinhole_view(situation.camera, poses[0], scoring).camera,
            poses,
            scoring.max_range,
            self.config.beliefs(),
            num_bins=state.num_bins,
            num_steps=math.ceil(float(scoring.max_range) / float(grid.cell_size)),
        )
        return candidates, {"utility": np.asarray(utility, dtype=np.float64)}
