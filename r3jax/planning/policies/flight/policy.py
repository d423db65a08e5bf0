"""Ours, whole flights: the place to which the flight shows most for its time.

Places are drawn near the robot, in sight of the frontier, and spread over all that it can reach. A
flight to one of them has a frame at every piece of its way, and is worth what these frames
show together (`flights`), over the seconds that it takes:

    rate = gain / (spare seconds + length / speed + seconds of its frames)

For loops that capture frames on the way; how far apart they lie is a setting here, too.

Shape symbols: C candidates.
"""

import math
from dataclasses import dataclass, field, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.planning.candidates import Candidates, candidates_at, spread
from r3jax.planning.config import PlannerConfig
from r3jax.planning.greedy import Drawn, GreedyPolicy, draw_positions
from r3jax.planning.policies.flight.flights import flights_to, fly, sights_of
from r3jax.planning.policy import Situation
from r3jax.scoring.batch import cache_positions_near
from r3jax.scoring.gather import gather_in_range

_SPEED = 1.0
"""Speed of a robot whose motion does not say [m/s]."""


@dataclass(frozen=True)
class PathConfig(PlannerConfig):
    """How flights are compared, beside what all policies share."""

    radius: float = 1.5
    """Local candidates lie within this distance of the robot [m]."""

    num_frontier: int = 20
    """Candidates that are aimed at the reachable frontier."""

    num_spread: int = 60
    """Candidates that are spread over all reachable space."""

    look_every: float = 0.3
    """Frames on the way lie so far apart [m], as the loop's `capture_every` has it."""

    spare_seconds: float = 4.0
    """Counted for each flight beside its own time [s]: less of it makes flights shorter."""

    frame_seconds: float = 0.03
    """What a frame takes [s]."""

    sample: int = 12
    """One voxel, and one cell, of so many stands for all."""

    gain: bool = True
    """Voxels count by what a look makes of R; False: by 1 - R."""

    def __post_init__(self) -> None:
        """Refuses values that would fail later, and says which."""
        super().__post_init__()
        for name, least in (("num_spread", 0), ("sample", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} must be at least {least}, got {getattr(self, name)}")
        for name, least in (("look_every", 0.01), ("spare_seconds", 0.0), ("frame_seconds", 0.0)):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= least):
                raise ValueError(f"{name} must be a finite number >= {least:g}, got {value}")


@dataclass(frozen=True)
class OursPath(GreedyPolicy):
    """The place to which the flight, all its frames together, shows most for its time."""

    config: PathConfig = field(default_factory=PathConfig)

    name = "ours-path"
    source = "whole flights on Ours-Pano, this project"
    Config = PathConfig

    # The best few alone are no net of places to fly over.
    scores_by_notes = True

    def draw(self, situation: Situation, *, key: Array) -> Drawn:
        """Positions of Ours, and some spread over all reachable space; no directions yet."""
        travel, num = situation.travel, self.config.num_candidates
        num_spread = min(self.config.num_spread, num - 1)
        own = replace(
            self.config,
            num_candidates=num - num_spread,
            num_frontier=min(self.config.num_frontier, num - num_spread),
            refine=0,
        )
        positions, _ = draw_positions(travel, situation.scoring_grid, own, key=key)
        stops = travel.stops(np.argwhere(travel.goals))
        if len(positions) == 0 or len(stops) == 0:
            return Drawn(candidates_at(stops[:0]), situation.memory)
        wide = stops[spread(stops, num_spread)] if num_spread else stops[:0]
        return Drawn(candidates_at(np.concatenate([positions, wide])).padded(num), situation.memory)

    def score(
        self, situation: Situation, candidates: Candidates, *, key: Array
    ) -> tuple[Candidates, dict[str, np.ndarray]]:
        """Every place's last look and what that adds, and the rate of the flight to it.

        A place that no flight leads to has no rate: -inf.
        """
        del key
        config, scoring = self.config, self.config.scoring
        places = candidates.position
        at = jnp.asarray(places, dtype=jnp.float32)
        voxels, cells, _ = gather_in_range(situation.map_state, situation.scoring_grid, at, scoring)
        _, kept = cache_positions_near(voxels, cells, situation.camera, at, scoring)
        sights = sights_of(
            kept, voxels, cells, places, situation.camera, scoring,
            every=config.sample, is_gain=config.gain,
        )  # fmt: skip
        tree = flights_to(situation.travel, places)
        gains, axes, adds = fly(sights, tree, config.look_every)
        frames = np.maximum(np.floor(tree.lengths / config.look_every), 1.0)
        speed = situation.limits.motion.speed or _SPEED
        seconds = tree.lengths / speed + config.frame_seconds * frames
        # Shut in so that no straight way is safe, all places are alike.
        rate = np.full(len(places), -np.inf if len(tree.order) else 0.0)
        utility = np.zeros(len(places))
        rate[tree.order] = gains / np.maximum(config.spare_seconds + seconds, 1e-9)
        utility[tree.order] = adds
        direction = candidates.direction.copy()
        direction[tree.order] = fibonacci_lattice(scoring.panorama_bins)[axes]
        turned = eqx.tree_at(lambda c: c.direction, candidates, direction)
        return turned, {"utility": utility, "rate": rate}

    def weigh(self, utilities: dict[str, np.ndarray]) -> np.ndarray:
        """The rate of the flight: the path is in it."""
        return utilities["rate"]
