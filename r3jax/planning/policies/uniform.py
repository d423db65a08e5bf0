"""Farthest point: spread the views evenly over free space and directions, blind to the scene.

    distance(a, b) = |x_a - x_b|  +  angle between the viewing axes / (90 degrees per meter)

The next view is the candidate whose nearest pose taken so far is farthest away (Gonzalez 1985).
Candidates lie anywhere that the robot can go, not only near it, and paths cost nothing. POp-GS
reports that even spreading beats FisherRF: a floor that a method must clear.

Shape symbols: C candidates; K room for poses, of which `num` are in use.
"""

from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.candidates import Candidates
from r3jax.planning.decision import PlannerState
from r3jax.planning.greedy import Drawn, GreedyPolicy, free_views
from r3jax.planning.policy import Situation

METRES_PER_RADIAN = 2.0 / np.pi
"""A quarter turn counts as much as a meter."""

FIRST_ROOM = 256
"""Poses that the memory holds before it doubles."""


class PosesTaken(eqx.Module):
    """Where views were taken, and which way they look. Doubles when it is full."""

    position: Float[Array, "K 3"] = eqx.field(converter=jnp.asarray)
    """Camera centers [m]; meaningless from `num` on."""

    axis: Float[Array, "K 3"] = eqx.field(converter=jnp.asarray)
    """Unit vector along which it looks; meaningless from `num` on."""

    num: Int[Array, ""] = eqx.field(converter=jnp.asarray)
    """Poses in use."""


def no_poses(room: int = FIRST_ROOM) -> PosesTaken:
    """The memory before the first view."""
    nothing = np.zeros((room, 3), dtype=np.float32)
    return PosesTaken(nothing, nothing, np.int32(0))


def remember(taken: PosesTaken, T_world_camera: np.ndarray) -> PosesTaken:
    """The poses with one more; none is ever lost."""
    num, room = int(taken.num), len(taken.position)
    # Doubling keeps the shapes few: a checkpoint or a jit sees a handful of sizes.
    growth = ((0, room if num == room else 0), (0, 0))
    position, axis = (np.pad(np.asarray(x), growth) for x in (taken.position, taken.axis))
    position[num], axis[num] = T_world_camera[:3, 3], T_world_camera[:3, 2]
    return PosesTaken(position, axis, np.int32(num + 1))


def nearest_taken(taken: PosesTaken, candidates: Candidates) -> np.ndarray:
    """Distance from each candidate to the nearest pose taken, [C] float64; inf: none was.

    Meters between the cameras plus a meter for every 90 degrees between their axes. Roll does not
    count: the views have none.
    """
    num = int(taken.num)
    # Before the first view every candidate is as far as any other.
    if num == 0:
        return np.full(len(candidates.valid), np.inf)
    position, axis = (np.asarray(x, np.float64)[:num] for x in (taken.position, taken.axis))
    apart = np.linalg.norm(candidates.position[:, None] - position, axis=-1)
    # Rounding may carry a cosine past 1, where arccos is NaN.
    cosine = np.clip(candidates.axis @ axis.T, -1.0, 1.0)
    return (apart + METRES_PER_RADIAN * np.arccos(cosine)).min(axis=1)


@dataclass(frozen=True)
class Uniform(GreedyPolicy):
    """The random view in all reachable space that is farthest from every view taken so far."""

    name = "uniform"
    source = "farthest-point sampling, Gonzalez 1985"

    def first_memory(self, camera: Camera, grid: OccupancyGrid) -> Any:
        """No pose."""
        del camera, grid
        return no_poses()

    def observe(self, state: PlannerState, map_state: MapState, frame: Frame) -> PlannerState:
        """Remembers where the frame was taken."""
        del map_state
        return replace(state, memory=remember(state.memory, np.asarray(frame.T_world_camera)))

    def draw(self, situation: Situation, *, key: Array) -> Drawn:
        """Positions uniform over all cells where the robot may stop, random directions."""
        # No radius: even spreading is meant over all space, and paths cost nothing.
        views = free_views(situation, self.config.num_candidates, np.inf, key=key)
        return Drawn(views, situation.memory)

    def score(
        self, situation: Situation, candidates: Candidates, *, key: Array
    ) -> tuple[Candidates, dict[str, np.ndarray]]:
        """Distance to the nearest pose taken so far."""
        del key
        return candidates, {"utility": nearest_taken(situation.memory, candidates)}

    def weigh(self, utilities: dict[str, np.ndarray]) -> np.ndarray:
        """The distance alone: paths cost nothing."""
        return utilities["utility"]
