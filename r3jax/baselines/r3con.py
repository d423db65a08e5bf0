"""R3CON: the rule of the paper's own code, which differs from its text (arXiv 2601.07484).

    utility = 1000 * unexplored cells in sight all round + sum of (1 - R) over voxels in sight
    total   = utility / sum of utilities - w * path / sum of paths
    w       = the greatest mean of (1 - R) over what a candidate sees

Candidates are centers of cells within 2 m, none at the frontier, and the present one is left out.
The field of view plays no part in the utility: the direction is chosen afterwards, the axis round
which a cone of half the smaller field of view holds the greatest sum. The weight of the path falls
as the place becomes well rendered. Re-implemented from the facts on this project's map, whose R it
takes; nothing is copied. A cell that is neither free nor occupied counts, however often it was
looked at. There a cell that was touched once never counts again, and scenes with missing surfaces
have a stored mask of what can be seen at all, an oracle that is left out here.

Shape symbols: C candidates; B bins of the panorama.
"""

import functools
import math
from dataclasses import dataclass, field

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from r3jax.errors import InputError
from r3jax.geometry.cameras import Camera
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.kernels.calls import Cells
from r3jax.mapping.state import MapState
from r3jax.planning.candidates import Candidates, candidates_along, candidates_at, host_generator
from r3jax.planning.config import PlannerConfig
from r3jax.planning.decide import Drawn, GreedyPolicy, net_utility
from r3jax.planning.policy import Situation
from r3jax.scoring.backend import sums_and_seen
from r3jax.scoring.batch import map_over_devices
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.gather import gather_in_range
from r3jax.visibility.views import panorama_view


@dataclass(frozen=True)
class R3conConfig(PlannerConfig):
    """Settings of `r3con`: the authors' values. It has no `lambda1`, `lambda2` and frontier."""

    num_candidates: int = 50
    """Positions that are scored per decision."""

    radius: float = 2.0
    """Candidates lie within this distance of the robot [m]."""

    num_frontier: int = 0
    """None is aimed at the frontier."""

    cell_weight: float = 1000.0
    """Weight of a visible unexplored cell against a voxel that renders badly."""

    path_weight: float | None = None
    """Weight of the path's share; None: adaptive, the greatest mean of (1 - R)."""

    all_round: bool = True
    """Whether the utility is that of all directions; else that of the cone it will look into."""

    def __post_init__(self) -> None:
        """Refuses values that would fail later, and says which."""
        super().__post_init__()
        if not (math.isfinite(self.cell_weight) and self.cell_weight >= 0.0):
            raise InputError(f"cell_weight must be a finite number >= 0, got {self.cell_weight}")
        weight = self.path_weight
        if weight is not None and not (math.isfinite(weight) and weight >= 0.0):
            raise InputError(f"path_weight must be a finite number >= 0 or none, got {weight}")


@dataclass(frozen=True)
class R3con(GreedyPolicy):
    """The rule of the authors' own code: position, then direction; adaptive path weight."""

    config: R3conConfig = field(default_factory=R3conConfig)

    name = "r3con"
    source = "the authors' code, jkff00/R3CON d980adc"
    Config = R3conConfig

    def draw(self, situation: Situation, *, key: Array) -> Drawn:
        """Draws centers of different safe cells within the radius."""
        travel, num = situation.travel, self.config.num_candidates
        cells = np.argwhere(travel.goals)
        is_other = np.any(cells != np.array(travel.start_cell), axis=1)
        stops = travel.stops(cells[is_other])
        stops = stops[np.linalg.norm(stops - travel.start, axis=1) <= self.config.radius]
        if len(stops) == 0:
            return Drawn(candidates_at(np.zeros((0, 3))), situation.memory)
        chosen = host_generator(key).permutation(len(stops))[:num]
        return Drawn(candidates_at(stops[chosen]).padded(num), situation.memory)

    def score(
        self, situation: Situation, candidates: Candidates, *, key: Array
    ) -> tuple[Candidates, dict[str, np.ndarray]]:
        """Computes the utility all round every position, and its best direction."""
        del key
        positions, scoring = candidates.position, self.config.scoring
        places = jnp.asarray(positions, dtype=jnp.float32)
        at_hand = gather_in_range(situation.map_state, situation.grid, places, scoring)
        allowed = situation.limits.allowed_axes(positions, scoring.panorama_bins)
        weight = jnp.asarray(self.config.cell_weight, dtype=jnp.float32)
        look = functools.partial(_look_round, *at_hand[:2], situation.camera, scoring, weight)
        axis, in_cone, cells, lack, voxels = map_over_devices(
            look, (places, jnp.asarray(allowed)), threads=1
        )
        turned = candidates_along(positions, np.asarray(axis, dtype=np.float64))
        turned = eqx.tree_at(lambda c: c.valid, turned, candidates.valid)
        in_cone, cells, lack, voxels = (
            np.asarray(x, dtype=np.float64) for x in (in_cone, cells, lack, voxels)
        )
        all_round = self.config.cell_weight * cells + lack
        return turned, {
            "exploration": cells,
            "rendering": lack,
            # What sees no voxel does not raise the weight of paths.
            "mean_lack": lack / np.maximum(voxels, 1.0),
            "utility": all_round if self.config.all_round else in_cone,
        }

    def weigh(self, utilities: dict[str, np.ndarray]) -> np.ndarray:
        """Combines utility and path; unreachable candidates do not affect the weight of paths."""
        path = utilities["path"]  # inf for padding, too
        counts = np.isfinite(path)
        weight = utilities["mean_lack"][counts].max() if counts.any() else 0.0
        if self.config.path_weight is not None:
            weight = self.config.path_weight
        return net_utility(utilities["utility"], path, float(weight))


@jax.jit
def _look_round(
    voxels: MapState,
    cells: Cells,
    camera: Camera,
    config: ScoringConfig,
    cell_weight: Float[Array, ""],
    places: tuple[Float[Array, "C 3"], Bool[Array, "C B"]],
) -> tuple[Float[Array, "C 3"], *tuple[Float[Array, " C"], ...]]:
    """Finds the best axis of each position, and sums what is visible from there.

    Returns the axis, the sum in its cone, the visible cells, the sum of (1 - R), and the visible
    voxels.

    Cells are the unexplored ones, and all but the second are of all directions.
    """
    num_bins = config.panorama_bins
    lattice = jnp.asarray(fibonacci_lattice(num_bins), dtype=jnp.float32)
    cone = (lattice @ lattice.T >= jnp.cos(_cone_angle(camera))).astype(jnp.float32)

    def look(
        place: tuple[Float[Array, " 3"], Bool[Array, " B"]],
    ) -> tuple[Float[Array, " 3"], *tuple[Float[Array, ""], ...]]:
        position, allowed = place
        view = panorama_view(position, config)
        lack, empty, seen, _ = sums_and_seen(voxels, cells, view, camera.focal, config, num_bins)
        sums = cone @ (lack + cell_weight * empty)
        best = jnp.argmax(jnp.where(allowed, sums, -jnp.inf))
        num_voxels = jnp.sum(jax.lax.population_count(seen), dtype=jnp.float32)
        return lattice[best], sums[best], empty.sum(), lack.sum(), num_voxels

    return jax.vmap(look)(places)


def _cone_angle(camera: Camera) -> Float[Array, ""]:
    """Computes half the smaller field of view [rad]."""
    return jnp.minimum(
        jnp.arctan(0.5 * camera.width / camera.fx), jnp.arctan(0.5 * camera.height / camera.fy)
    )
