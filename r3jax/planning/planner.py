"""The three verbs of a plug-in: start a planner, let it observe frames, let it decide.

    planner = r3jax.start(camera, bounds, "r3-pano")
    planner = r3jax.observe(planner, frame)
    decision, planner, info = r3jax.decide(planner, frame.T_world_camera, key)

`explore` is the loop over these three with a simulator, a clock, a budget and a record. A planner
is immutable: the one before a call is still what it was.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from r3jax.frame import Frame, a_frame
from r3jax.geometry.arguments import a_camera, a_pose, checked, one
from r3jax.geometry.cameras import Camera
from r3jax.geometry.voxels import check_near_origin
from r3jax.kernels.native.ahead import compile_ahead
from r3jax.kernels.native.platform import is_cpu_only
from r3jax.mapping.config import MappingConfig
from r3jax.mapping.occupancy import OccupancyGrid, empty_grid, integrate_depth, mark_free_ball
from r3jax.mapping.state import MapState, empty_map
from r3jax.mapping.update import integrate_growing
from r3jax.planning.decide import PlannerState
from r3jax.planning.policy import Decision, DecisionOutcome, PlanInfo, PlansAhead, Policy
from r3jax.planning.pose_check import Reference, check_poses
from r3jax.planning.registry import make_policy
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.simulated import imagine_view

_integrate_depth = jax.jit(integrate_depth)
_mark_free_ball = jax.jit(mark_free_ball)


class Planner(eqx.Module):
    """What is known, and what the policy remembers; `start` makes one."""

    map_state: MapState
    """What was seen, from where and how consistently."""

    grid: OccupancyGrid
    """Free, occupied and unexplored space."""

    policy_state: Any
    """What the policy remembers: a pytree of its own."""

    policy: Policy = eqx.field(static=True)
    """Chooses the next view."""

    config: MappingConfig = eqx.field(static=True)
    """How frames join the map and the grid."""

    reference: Reference | None = None
    """An early frame, kept until the poses of the later ones have been found to fit the depth."""


a_planner = one(Planner, "r3jax.start makes one")


@checked(camera=a_camera)
def start(
    camera: Camera,
    bounds: ArrayLike,
    policy: Policy | str = "r3-pano",
    *,
    starts: Iterable[ArrayLike] = (),
    config: MappingConfig | None = None,
    key: Array | None = None,
) -> Planner:
    """Starts a planner that has seen nothing.

    The first one on a machine also starts a process that compiles the kernels for CPUs.

    Args:
        camera: of the frames to come.
        bounds: box of the space to explore: lower and upper corner, [2, 3] [m].
        policy: an object, or its name in `r3jax policies`.
        starts: poses [4, 4] where cameras begin: the ball of `config.start_radius` round each is
            free, which no depth image shows from inside. Without one the robot may find itself
            shut in until it has seen more.
        config: voxels, cells, the sensor's range.
        key: of the policy's first state; None: `jax.random.key(0)`.

    Raises:
        ValueError: no box, too many cells, a policy that is not known.
    """
    if is_cpu_only():
        compile_ahead()
    config = MappingConfig() if config is None else config
    policy = make_policy(policy) if isinstance(policy, str) else policy
    # A fixed default: a plug-in without a seed still decides the same way twice.
    key = jax.random.key(0) if key is None else key
    grid = first_grid(np.asarray(bounds, dtype=np.float64), starts, config)
    map_state = empty_map(config.capacity, config.voxel_size, config.num_bins)
    return Planner(map_state, grid, policy.init(camera, grid, key=key), policy, config)


@checked(planner=a_planner, frame=a_frame)
def observe(planner: Planner, frame: Frame) -> Planner:
    """Adds a frame to the map and to the grid, and tells the policy.

    Not to be called under jit: the table of the map grows by itself. Warns where the poses of the
    first frames contradict their depth: they are then of another convention, or not rigid motions
    of one camera at all.

    Args:
        planner: before the frame.
        frame: a posed RGB-D image.
    """
    reference = check_poses(planner.reference, frame)
    return replace(take_in(planner, frame), reference=reference)


def take_in(planner: Planner, frame: Frame) -> Planner:
    """Adds a frame as `observe` does, without a check of its pose: that of a simulator is right."""
    map_state, grid = add_frame(planner.map_state, planner.grid, frame, planner.config)
    return tell_policy(replace(planner, map_state=map_state, grid=grid), frame)


@checked(planner=a_planner, T_world_camera=a_pose)
def decide(
    planner: Planner, T_world_camera: ArrayLike, key: Array
) -> tuple[Decision | None, Planner, PlanInfo]:
    """Returns decides where to look next.

    Args:
        planner: what is known.
        T_world_camera: where the camera is, [4, 4].
        key: randomness of this decision; a new one for each.

    Returns:
        The decision, or None if there is no view to take; the planner, which remembers it; and what
        happened, with the reason in `outcome`.

    Raises:
        ValueError: a camera more than 32 km from the origin.
    """
    # float64: the path begins at this very position.
    pose = np.asarray(T_world_camera, dtype=np.float64)
    check_near_origin("T_world_camera", pose[:3, 3])
    decision, policy_state, info = planner.policy.decide(
        planner.policy_state, planner.map_state, planner.grid, pose, key=key
    )
    return decision, replace(planner, policy_state=policy_state), info


def decide_ahead(
    planner: Planner, camera: Camera, T_next: np.ndarray, key: Array, scoring: ScoringConfig
) -> tuple[Decision | None, Planner, PlanInfo]:
    """Decides on the view after the next one, on the map as that one is expected to leave it.

    Args:
        planner: what is known while the camera is on its way.
        camera: of the view that it is on its way to.
        T_next: pose of that view, [4, 4].
        key: randomness of this decision.
        scoring: range and size of the depth buffer of the imagined view.

    Returns:
        As `decide`; None also for a policy that cannot `reconsider`. Of the policy's memory only
        what drawing and choosing noted: the path has not been flown, and nothing was looked at.
    """
    if not isinstance(planner.policy, PlansAhead):
        return None, planner, PlanInfo(DecisionOutcome.NO_CANDIDATE)
    pose = jnp.asarray(T_next, dtype=jnp.float32)
    map_state, grid = imagine_view(planner.map_state, planner.grid, camera, pose, scoring)
    decision, state, info = planner.policy.decide(
        planner.policy_state, map_state, grid, np.asarray(T_next, np.float64), key=key
    )
    if isinstance(planner.policy_state, PlannerState):
        state = replace(planner.policy_state, memory=state.memory)
    return decision, replace(planner, policy_state=state), info


def reconsider(
    planner: Planner, T_world_camera: np.ndarray, planned: Decision, key: Array
) -> tuple[Decision | None, Planner, PlanInfo]:
    """Decides again among the best candidates of `decide_ahead`, on what has come in since.

    Args:
        planner: what is known now.
        T_world_camera: where the camera has arrived, [4, 4].
        planned: what `decide_ahead` decided.
        key: randomness of this decision.

    Returns:
        As `decide`; None if no path leads to any of these candidates.
    """
    policy = planner.policy
    assert isinstance(policy, PlansAhead)  # or `decide_ahead` had decided nothing
    decision, state, info = policy.reconsider(
        planner.policy_state, planner.map_state, planner.grid, T_world_camera, planned, key=key
    )
    return decision, replace(planner, policy_state=state), info


def tell_policy(planner: Planner, frame: Frame) -> Planner:
    """Tells the policy of a frame that is in the map already."""
    state = planner.policy.observe(planner.policy_state, planner.map_state, frame)
    return replace(planner, policy_state=state)


def follow(planner: Planner, T_world_camera: np.ndarray, waypoints: np.ndarray) -> Planner:
    """Notifies the policy of a path that another one chose, before the robot follows it.

    Args:
        planner: what is known.
        T_world_camera: where the latest view was taken, [4, 4].
        waypoints: the path to the next one, [K, 3] [m].
    """
    policy_state = planner.policy.follow(
        planner.policy_state, planner.map_state, planner.grid, T_world_camera, waypoints
    )
    return replace(planner, policy_state=policy_state)


def first_grid(
    bounds: np.ndarray, starts: Iterable[ArrayLike], config: MappingConfig
) -> OccupancyGrid:
    """Makes the grid before the first view: the ball round each start is free, nothing else known.

    Args:
        bounds: box of the world, [2, 3] [m].
        starts: start poses, [4, 4] each; several cameras may start at several places.
        config: size of the cells and of the ball.
    """
    # No image shows the ball round the start; without it the robot stands in the unknown.
    grid = empty_grid(bounds, config.cell_size)
    for pose in starts:
        position = jnp.asarray(np.asarray(pose)[:3, 3], dtype=jnp.float32)
        grid = _mark_free_ball(grid, position, config.start_radius)
    return grid


def add_frame(
    map_state: MapState, grid: OccupancyGrid, frame: Frame, config: MappingConfig
) -> tuple[MapState, OccupancyGrid]:
    """Adds a frame to a map and a grid, as `observe` does; the table grows."""
    map_state = integrate_growing(
        map_state,
        frame,
        config.max_range,
        allow_growth=config.allow_growth,
        drop_edges=config.drop_edges,
    )
    # Depth before the body: a hit measured in this frame must not be vouched away.
    grid = _integrate_depth(grid, frame, config.max_range)
    position = np.asarray(frame.T_world_camera)[:3, 3]
    return map_state, _mark_free_ball(grid, position, config.body_radius)
