"""What the cameras of a team tell each other: frames, joined to one map in the order of the clock.

Maps of their own would not merge into the map of one camera: a frame also marks what it saw of
the voxels that others had put there (`scoring.sighting`), and the grid clips its log-odds. Frames
in one order do: whoever has heard of the same frames has the same map, bit for bit.
"""

import math
from dataclasses import dataclass
from operator import attrgetter

import numpy as np

from r3jax.exploration.clock import timed
from r3jax.exploration.config import ExplorationConfig
from r3jax.frame import Frame
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.planner import add_frame


@dataclass(frozen=True)
class Sight:
    """A frame that a member has taken."""

    seconds: float
    """Its mission clock when the frame was in its own map [s]."""

    member: int

    frame: Frame


@dataclass(frozen=True)
class Told:
    """A frame that has become common, and what all know since."""

    sight: Sight

    mapping: float
    """Seconds that it took to join the common map."""

    voxels: int
    """Occupied voxels of that map."""

    known_share: float
    """Known cells over all cells of the scene's box."""


@dataclass(frozen=True)
class Common:
    """What all have told each other, and what they have not yet."""

    map_state: MapState
    """Map of the frames that were told."""

    grid: OccupancyGrid

    waiting: tuple[Sight, ...] = ()
    """Taken and not told yet."""


def last_meeting(seconds: float, meet_every: float) -> float:
    """The clock at the last meeting [s]; 0 for `meet_every`: the radio is always on."""
    return math.floor(seconds / meet_every) * meet_every if meet_every > 0.0 else seconds


def in_order(sights: tuple[Sight, ...]) -> list[Sight]:
    """By the clock; of two at the same time, the first member's comes first."""
    return sorted(sights, key=attrgetter("seconds", "member"))


def tell(
    common: Common, until: float, config: ExplorationConfig, *, repeat_compiled: bool
) -> tuple[Common, list[Told]]:
    """A meeting: all frames up to a time join the common map.

    Args:
        common: before.
        until: mission clock [s]. No frame up to then may be told of later.
        config: of the maps.
        repeat_compiled: False where nobody needs the exact time.

    Returns:
        What is common now, and the frames that have become so, in order.
    """
    told: list[Told] = []
    map_state, grid = common.map_state, common.grid
    for sight in in_order(common.waiting):
        if sight.seconds > until:
            continue
        (map_state, grid), seconds = timed(
            add_frame, map_state, grid, sight.frame, config, repeat_compiled=repeat_compiled
        )
        known_share = 1.0 - float(np.mean(np.asarray(grid.unexplored)))
        told.append(Told(sight, seconds, int(map_state.num_occupied), known_share))
    waiting = tuple(sight for sight in common.waiting if sight.seconds > until)
    return Common(map_state, grid, waiting), told
