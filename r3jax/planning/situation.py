"""All that a decision may depend on."""

from dataclasses import dataclass, field
from typing import Any

from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.limits import Limits
from r3jax.planning.travel import Travel


@dataclass(frozen=True)
class Situation:
    """All that a decision may depend on: what is known, where the robot is and can go."""

    map_state: MapState

    grid: OccupancyGrid
    """As it is; for travel."""

    scoring_grid: OccupancyGrid
    """Without unexplored cells that are not worth a look (`prepare_decision`); for utilities."""

    travel: Travel
    """Where the robot can go from here."""

    camera: Camera
    """Of every frame to come."""

    memory: Any
    """What the policy keeps beside the map."""

    limits: Limits = field(default_factory=Limits)
    """What the carrier of the camera may do next. Candidates need not lie within them: `decide`
    sees to that."""

    notes: Any = None
    """What `draw` noted of the candidates."""
