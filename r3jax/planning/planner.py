"""The three verbs for robots and SLAM systems: `start` a planner, `observe` frames, `decide`.

    planner = r3jax.start(camera, bounds, "r3-pano")
    planner = r3jax.observe(planner, frame)
    decision, planner, info = r3jax.decide(planner, frame.T_world_camera, key)

`explore` is the loop over them, with a simulator, a clock, a budget and a record. Planners are
immutable: each call returns a new one.
"""

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from r3jax.errors import InputError
from r3jax.frame import Frame, a_frame
from r3jax.geometry.arguments import a_camera, a_pose, checked, one
from r3jax.geometry.cameras import Camera
from r3jax.geometry.voxels import check_near_origin
from r3jax.kernels.native.ahead import compile_ahead
from r3jax.kernels.native.platform import is_cpu_only
from r3jax.mapping.config import MappingConfig
from r3jax.mapping.occupancy import (
    COSTMAP,
    KEEP_OUT,
    REFUSED,
    TRUSTED,
    OccupancyGrid,
    empty_grid,
    integrate_depth,
    integrate_rays,
    mark_free_ball,
    squared_distance,
)
from r3jax.mapping.state import MapState, empty_map
from r3jax.mapping.tile_files import TILE_MEMORY, open_tile_folder
from r3jax.mapping.tiles import check_view, whole_map
from r3jax.mapping.update import integrate_growing
from r3jax.planning.columns import Plane, cells_of, pixel_columns, polygon_columns, without
from r3jax.planning.decide import GreedyPolicy, PlannerState, with_others
from r3jax.planning.far import (
    Far,
    arrived,
    check_policy,
    first_far,
    moved_to,
    weigh_far,
    with_coarse,
    with_columns,
    with_views,
)
from r3jax.planning.policy import Decision, DecisionOutcome, PlanInfo, PlansAhead, Policy
from r3jax.planning.pose_check import Reference, check_poses
from r3jax.planning.registry import make_policy
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.simulated import imagine_view

_integrate_depth = jax.jit(integrate_depth)
_mark_free_ball = jax.jit(mark_free_ball)


class Planner(eqx.Module):
    """A planner: map, grid, policy and the policy's memory. Made by `start`."""

    map_state: MapState
    """The voxel map."""

    grid: OccupancyGrid
    """Free, occupied and unexplored space."""

    policy_state: Any
    """The policy's memory, a pytree."""

    policy: Policy = eqx.field(static=True)
    """The policy that chooses the next view."""

    config: MappingConfig = eqx.field(static=True)
    """Settings of the map and the grid."""

    reference: Reference | None = None
    """An early frame, kept until the poses of later frames agree with its depth."""

    far: Far | None = eqx.field(static=True, default=None)
    """All that is not at hand (`planning.far`); None: all is."""

    @property
    def whole_map(self) -> MapState:
        """All voxels in one table: those at hand, and those in tiles."""
        return self.map_state if self.far is None else whole_map(self.map_state, self.far.tiles)

    @property
    def whole_grid(self) -> OccupancyGrid:
        """All cells in one grid: those at hand, and those in tiles.

        Raises:
            ValueError: more cells than a grid may have.
        """
        return self.grid if self.far is None else self.far.whole_grid(self.grid)


a_planner = one(Planner, "r3jax.start makes one")


@checked(camera=a_camera)
def start(
    camera: Camera,
    bounds: ArrayLike | None = None,
    policy: Policy | str = "r3-pano",
    *,
    starts: Iterable[ArrayLike] = (),
    config: MappingConfig | None = None,
    key: Array | None = None,
    tile_folder: str | Path | None = None,
    tile_memory: float | int = TILE_MEMORY,
) -> Planner:
    """Starts a planner with an empty map.

    The first one on a machine also starts a process that compiles the CPU kernels.

    Args:
        camera: of the frames; the widest of them.
        bounds: box of the space to explore: lower and upper corner, [2, 3] [m]. None, or infinite
            along some axes: a place of any size, of which what lies round the robot is at hand and
            all else in tiles (`MappingConfig.tiles`); for r3, r3-pano, r3-ahead, frontier.
        policy: a policy, or its name (`r3jax policies` lists them).
        starts: initial poses [4, 4] of the cameras. The ball of `config.start_radius` around each
            counts as free, because no depth image shows it. Without a start the robot may be shut
            in at first.
        config: sizes of voxels and cells, range of the sensor.
        key: random key for the policy's initial memory; None: `jax.random.key(0)`.
        tile_folder: scratch folder on a local disk for tiles that memory has no room for; several
            processes may use one. Their files are deleted once no planner uses them. None: all
            tiles stay in memory.
        tile_memory: memory of the tiles beyond which the farthest go to disk [bytes].

    Raises:
        ValueError: an invalid box, too many cells, an unknown policy; a tile folder that holds
            something else, cannot be written, or is given without tiles.
    """
    if is_cpu_only():
        compile_ahead()
    config = MappingConfig() if config is None else config
    policy = make_policy(policy) if isinstance(policy, str) else policy
    # A fixed default, so that decisions are repeatable without a seed.
    key = jax.random.key(0) if key is None else key
    endless = [[-np.inf] * 3, [np.inf] * 3]
    box = np.asarray(endless if bounds is None else bounds, dtype=np.float64)
    if not config.tiles and np.all(np.isfinite(box)):
        if tile_folder is not None:
            raise InputError(
                "tile_folder is for a planner with tiles: leave out the bounds, or give "
                "config=MappingConfig(tiles=True)"
            )
        grid = first_grid(box, starts, config)
        return Planner(first_map(config), grid, policy.init(camera, grid, key=key), policy, config)
    starts = [np.asarray(pose) for pose in starts]
    far = first_far(config, policy, camera, box, starts)
    if tile_folder is not None:
        folder = open_tile_folder(tile_folder, tile_memory)
        far = replace(far, tiles=replace(far.tiles, folder=folder))
    config = replace(config, tiles=True, capacity=far.tiles.capacity)
    grid = far.grid(np.zeros(far.tiles.lattice.shape, np.float32))
    policy_state = policy.init(camera, grid, key=key)
    check_policy(policy, policy_state)
    planner = Planner(first_map(config), grid, policy_state, policy, config, far=far)
    for pose in [*starts, *starts[:1]]:  # the block ends where it begins, round the first one
        planner = at_hand(planner, np.asarray(pose, np.float64)[:3, 3])
        planner = replace(planner, grid=mark_starts(planner.grid, [pose], config))
    return planner


def at_hand(planner: Planner, position: np.ndarray) -> Planner:
    """Moves the block to a position [3] [m]; the same planner if it holds no tiles.

    For those who look at a planner's map round a place; `observe` and `decide` do it by themselves.
    """
    if planner.far is None:
        return planner
    known = (planner.map_state, planner.grid, planner.policy_state, planner.far)
    after = moved_to(known, cast(GreedyPolicy, planner.policy), np.asarray(position, np.float64))
    if after is known:
        return planner
    map_state, grid, policy_state, far = after
    return replace(planner, map_state=map_state, grid=grid, policy_state=policy_state, far=far)


@checked(planner=a_planner, frame=a_frame)
def observe(planner: Planner, frame: Frame) -> Planner:
    """Adds a frame to the map and the grid, and passes it to the policy.

    Not to be called under jit: the map's table grows when needed. Warns if the poses of the first
    frames contradict their depth, for example because of another pose convention.

    Args:
        planner: before the frame.
        frame: a posed RGB-D image.
    """
    reference = check_poses(planner.reference, frame)
    return replace(take_in(planner, frame), reference=reference)


def take_in(planner: Planner, frame: Frame, *, donate: bool = False) -> Planner:
    """Adds a frame as `observe` does, without checking its pose, for simulators.

    Args:
        planner: before the frame.
        frame: a posed RGB-D image.
        donate: the planner will not be used again, and its policy keeps no map.
    """
    if planner.far is not None:
        config = planner.config
        check_view(planner.far.tiles, frame.camera, config.max_range, config.voxel_size)
        planner = at_hand(planner, np.asarray(frame.T_world_camera)[:3, 3])
    before = planner.map_state.capacity
    known = planner.map_state, planner.grid
    map_state, grid = add_frame(*known, frame, planner.config, donate=donate)
    if planner.far is not None and map_state.capacity > before:
        rows, (x, y, _) = map_state.capacity, planner.far.tiles.lattice.size
        warnings.warn(
            f"the table at hand grows from {before} to {rows} rows, for which everything is "
            f"compiled: {int(map_state.num_occupied)} voxels lie in the {x:.0f} x {y:.0f} m "
            f"at hand; MappingConfig(capacity={rows}) begins with as many, and larger voxels, a "
            "shorter max_range or bounds that hold one floor make them fewer",
            stacklevel=3,
        )
    return tell_policy(replace(planner, map_state=map_state, grid=grid), frame)


@checked(planner=a_planner, T_world_camera=a_pose)
def decide(
    planner: Planner, T_world_camera: ArrayLike, key: Array
) -> tuple[Decision | None, Planner, PlanInfo]:
    """Chooses the next view and the path to it.

    Args:
        planner: the state.
        T_world_camera: where the camera is, [4, 4].
        key: random key; a new one for each decision.

    Returns:
        The decision, or None if there is no view to take; the planner with its updated memory; and
        information on the decision, with the reason in `outcome`.

    Raises:
        ValueError: a camera more than 32 km from the origin.
    """
    # float64: the path begins at this very position.
    pose = np.asarray(T_world_camera, dtype=np.float64)
    check_near_origin("T_world_camera", pose[:3, 3])
    planner = at_hand(planner, pose[:3, 3])
    decision, policy_state, info = planner.policy.decide(
        planner.policy_state, planner.map_state, planner.grid, pose, key=key
    )
    after = replace(planner, policy_state=policy_state)
    if planner.far is None:
        return decision, after, info
    if decision is not None and not planner.far.settled.coarse.tiles:
        # For its programs: the same score views when the block moves, which must not wait for them.
        known = planner.policy_state, planner.map_state, planner.grid, pose, decision
        cast(GreedyPolicy, planner.policy).reconsider(*known, key=key)
    return _decide_far(planner, after, pose, decision, info)


def _decide_far(
    before: Planner,
    after: Planner,
    pose: np.ndarray,
    decision: Decision | None,
    info: PlanInfo,
) -> tuple[Decision | None, Planner, PlanInfo]:
    """Compares views that were left for later with a decision within the block."""
    assert before.far is not None
    policy, here = cast(GreedyPolicy, before.policy), pose[:3, 3]
    memory = cast(PlannerState, after.policy_state)
    viewed = before.policy_state.memory
    # A policy that has viewed all frontier cells at hand starts over: first come those far away.
    starts_over = policy.memory_by_cell and bool(np.any(viewed & ~memory.memory))
    known = replace(memory, memory=viewed | memory.memory) if starts_over else memory
    far = with_coarse(arrived(before.far.settled, here), before.grid, known, policy.config)
    best, left = weigh_far(far, policy, None if starts_over else decision, pose)
    if decision is not None:
        left = with_views(left, decision, here, policy.config.radius)
    if best is not decision and best is not None:
        # The near view is not taken: its path leaves no trail, and its cells were not viewed.
        state = replace(memory, trail=left.trail, memory=before.policy_state.memory)
        if info.outcome is not DecisionOutcome.MOVED:
            info = PlanInfo(DecisionOutcome.MOVED, len(best.candidates), len(best.candidates),
                            info.stage_seconds)  # fmt: skip
        return best, replace(after, policy_state=state, far=left), info
    return decision, replace(after, far=left.with_trail(after.policy_state.trail)), info


@checked(planner=a_planner)
def observe_points(
    planner: Planner,
    points: ArrayLike,
    sensor_positions: ArrayLike,
    *,
    max_range: float | None = None,
) -> Planner:
    """Adds a LiDAR scan to the grid: free and occupied space, but no voxels to score.

    Args:
        planner: before the scan.
        points: end points of the rays, world, [n, 3] [m]. Rows that are not finite are ignored; if
            a point is beyond `max_range`, its ray is free up to there.
        sensor_positions: origins of the rays, [3] or [n, 3] [m].
        max_range: range of the LiDAR [m]; None: that of the depth camera.

    Raises:
        ValueError: other shapes, or no positive range.
    """
    ends = np.asarray(points, np.float64)
    if ends.ndim != 2 or ends.shape[1] != 3:
        raise InputError(f"points must be [n, 3] in meters, got shape {ends.shape}")
    begins = np.asarray(sensor_positions, np.float64)
    if begins.shape not in ((3,), ends.shape):
        raise InputError(
            f"sensor_positions must be [3], or one for each of {len(ends)} points, got shape "
            f"{begins.shape}"
        )
    reach = planner.config.max_range if max_range is None else max_range
    if not 0.0 < reach < np.inf:
        raise InputError(f"max_range must be positive and finite [m], got {max_range}")
    planner = at_hand(planner, np.median(begins.reshape(-1, 3), axis=0)) if ends.size else planner
    begins = np.broadcast_to(begins, ends.shape)
    is_valid = np.isfinite(ends).all(axis=1) & np.isfinite(begins).all(axis=1)
    grid = integrate_rays(planner.grid, ends[is_valid], begins[is_valid], reach)
    return replace(planner, grid=grid)


@checked(planner=a_planner)
def keep_out(planner: Planner, zones: Iterable[Any] | np.ndarray) -> Planner:
    """Sets the keep-out zones, replacing those of earlier calls; an empty list removes all.

    No part of a footprint enters them; for a flying camera, its center does not.

    Args:
        planner: before.
        zones: polygons, each with corners [k, 2] in the world [m], k >= 3; or a mask of the columns
            of `planner.grid`, [X, Y] bool. With tiles that grid moves with the robot: the mask
            closes the columns that it has now, which stay closed wherever the robot goes.

    Raises:
        ValueError: not a polygon, or a mask of another shape.
    """
    shape, (plane, first) = planner.grid.log_odds.shape, _plane_of(planner)
    if isinstance(zones, np.ndarray) and zones.dtype == bool:
        if zones.shape != shape[:2]:
            raise InputError(f"the mask must be [X, Y] = {list(shape[:2])}, got {zones.shape}")
        return _with_columns(planner, {KEEP_OUT: np.argwhere(zones) + first})
    found = [np.zeros((0, 2), np.int64)]
    for zone in zones:
        corners = np.asarray(zone, np.float64)
        if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
            raise InputError(
                f"a zone is a polygon of at least three corners [k, 2] in meters, got shape "
                f"{corners.shape}"
            )
        if not np.isfinite(corners).all():
            raise InputError(f"corners of a zone must be finite, got {corners.tolist()}")
        found.append(polygon_columns(plane, corners))
    return _with_columns(planner, {KEEP_OUT: np.concatenate(found)})


def _plane_of(planner: Planner) -> tuple[Plane, np.ndarray]:
    """Returns the lattice of the planner's columns, and the first column at hand, [2]."""
    if planner.far is not None:
        return planner.far.plane, planner.far.first_cell[:2]
    grid, first = planner.grid, np.zeros(2, np.int64)
    window = np.array([first, grid.log_odds.shape[:2]], np.float64)
    return Plane(np.asarray(grid.origin, np.float64)[:2], float(grid.cell_size), window), first


def _with_columns(planner: Planner, columns: dict[int, np.ndarray]) -> Planner:
    """Replaces the columns [k, 2] of some marks, at hand and far away."""
    grid, (_, first) = planner.grid, _plane_of(planner)
    for mark, found in columns.items():
        grid = grid.marked(cells_of(found - first, grid.log_odds.shape), mark)
    far = None if planner.far is None else with_columns(planner.far, columns)
    return replace(planner, grid=grid, far=far)


@checked(planner=a_planner)
def with_costmap(
    planner: Planner,
    data: ArrayLike,
    resolution: float,
    origin: Sequence[float] | np.ndarray,
    *,
    lethal: int = 100,
    trust_free: bool = False,
) -> Planner:
    """Closes the occupied pixels of a costmap, replacing an earlier costmap.

    Args:
        planner: before.
        data: a `nav_msgs/OccupancyGrid`: [height, width], row by row along y, -1 (not known) or 0
            to 100.
        resolution: side of a pixel [m].
        origin: x and y of the lower corner of pixel (0, 0), world [m]; without rotation.
        lethal: pixels of this value or more are closed. Nav2 publishes 100 for obstacles and 99
            where the robot's center would touch them, which r3jax computes itself from the
            footprint.
        trust_free: a robot with a footprint may enter what all pixels hold for free (0 to below
            `lethal`), seen by its camera or not: for a camera that does not show the floor near the
            robot, and a costmap of a LiDAR. What the camera has measured there stays an obstacle.

    Raises:
        ValueError: another shape, or a resolution that is not positive.
    """
    costs, corner = np.asarray(data), np.asarray(origin, np.float64)[:2]
    if costs.ndim != 2:
        raise InputError(
            f"data must be [height, width], got shape {costs.shape}: reshape it with the message's "
            "info.height and info.width"
        )
    if not 0.0 < resolution < np.inf:
        raise InputError(f"resolution must be positive [m], got {resolution}")
    corners_of = lambda pixels: corner + resolution * np.argwhere(pixels)[:, ::-1]
    plane, _ = _plane_of(planner)
    closed = pixel_columns(plane, corners_of(costs >= lethal), resolution)
    trusted = np.zeros((0, 2), np.int64)
    if trust_free:
        is_free = (costs >= 0) & (costs < lethal)
        free, others = (
            pixel_columns(plane, corners_of(pixels), resolution) for pixels in (is_free, ~is_free)
        )
        trusted = without(free, others)
    return _with_columns(planner, {COSTMAP: closed, TRUSTED: trusted})


@checked(planner=a_planner)
def refuse(planner: Planner, decision: Decision, radius: float = 0.5) -> Planner:
    """Records a goal that the robot could not reach, so that no goal near it is chosen again.

    Paths may still lead past it.

    Args:
        planner: the planner that made the decision, or a later one.
        decision: the decision with that goal.
        radius: radius around the goal [m].
    """
    goal = jnp.asarray(decision.T_world_camera[:3, 3], jnp.float32)
    if planner.far is not None:
        refused = np.append(decision.T_world_camera[:3, 3], radius)[None]
        far = replace(planner.far, refused=np.concatenate([planner.far.refused, refused]))
        planner = replace(planner, far=far)
    near = np.asarray(squared_distance(planner.grid, goal)) <= radius**2
    before = planner.grid.refused
    cells = near if before is None else near | before
    return replace(planner, grid=planner.grid.marked(cells, REFUSED))


def decide_ahead(
    planner: Planner, camera: Camera, T_next: np.ndarray, key: Array, scoring: ScoringConfig
) -> tuple[Decision | None, Planner, PlanInfo]:
    """Decides on the view after the next one, on the map predicted for after the next view.

    Args:
        planner: the planner while the camera moves.
        camera: of the next view.
        T_next: pose of the next view, [4, 4].
        key: randomness of this decision.
        scoring: range and size of the depth buffer of the imagined view.

    Returns:
        As `decide`; None also for a policy without `reconsider`. The policy's memory is only
        updated by drawing and choosing, not by the path or the view, which have not been taken;
        with tiles, not at all.
    """
    if not isinstance(planner.policy, PlansAhead):
        return None, planner, PlanInfo(DecisionOutcome.NO_CANDIDATE)
    there = at_hand(planner, T_next[:3, 3])
    pose = jnp.asarray(T_next, dtype=jnp.float32)
    map_state, grid = imagine_view(there.map_state, there.grid, camera, pose, scoring)
    decision, state, info = planner.policy.decide(
        there.policy_state, map_state, grid, np.asarray(T_next, np.float64), key=key
    )
    if planner.far is not None:  # its policy keeps nothing: the camera is not there yet
        if cast(GreedyPolicy, planner.policy).memory_by_cell:
            viewed, then = there.policy_state.memory, state.memory
            if np.any(viewed & ~then) or not np.any(then & ~viewed):
                decision = None  # nothing new at hand: to be decided with what is far away
        return decision, planner, info
    if isinstance(planner.policy_state, PlannerState):
        state = replace(planner.policy_state, memory=state.memory)
    return decision, replace(planner, policy_state=state), info


def reconsider(
    planner: Planner, T_world_camera: np.ndarray, planned: Decision, key: Array
) -> tuple[Decision | None, Planner, PlanInfo]:
    """Decides again among the best candidates of `decide_ahead`, on the current map.

    With tiles, goals far away are weighed as in `decide`, against all candidates: the best with
    their current scores, the others with those of `decide_ahead`.

    Args:
        planner: the current planner.
        T_world_camera: pose where the camera has arrived, [4, 4].
        planned: the result of `decide_ahead`.
        key: randomness of this decision.

    Returns:
        As `decide`; None if no path leads to any of these candidates.
    """
    policy = planner.policy
    assert isinstance(policy, PlansAhead)  # or `decide_ahead` had decided nothing
    planner = at_hand(planner, T_world_camera[:3, 3])
    known = planner.policy_state, planner.map_state, planner.grid, T_world_camera, planned
    if planner.far is None:
        decision, state, info = policy.reconsider(*known, key=key)
        return decision, replace(planner, policy_state=state), info
    decision, state, info = cast(GreedyPolicy, policy).reconsider(*known, key=key, notes=True)
    after = replace(planner, policy_state=state)
    if decision is None:
        return None, after, info
    every = with_others(decision, planned)
    best, after, info = _decide_far(planner, after, T_world_camera, every, info)
    return decision if best is every else best, after, info


def tell_policy(planner: Planner, frame: Frame) -> Planner:
    """Passes a frame that is in the map already to the policy."""
    state = planner.policy.observe(planner.policy_state, planner.map_state, frame)
    return replace(planner, policy_state=state)


def follow(planner: Planner, T_world_camera: np.ndarray, waypoints: np.ndarray) -> Planner:
    """Notifies the policy of a path that another one chose, before the robot follows it.

    Args:
        planner: the state.
        T_world_camera: where the latest view was taken, [4, 4].
        waypoints: the path to the next one, [K, 3] [m].
    """
    planner = at_hand(planner, T_world_camera[:3, 3])
    policy_state = planner.policy.follow(
        planner.policy_state, planner.map_state, planner.grid, T_world_camera, waypoints
    )
    return _with_trail(replace(planner, policy_state=policy_state))


def _with_trail(planner: Planner) -> Planner:
    """Adds the path that the policy has noted to the trails."""
    if planner.far is None:
        return planner
    return replace(planner, far=planner.far.with_trail(planner.policy_state.trail))


def first_map(config: MappingConfig) -> MapState:
    """Makes the map before the first view."""
    size = (config.capacity, config.voxel_size, config.num_bins)
    return empty_map(*size, remove_moved=config.remove_moved)


def first_grid(
    bounds: np.ndarray, starts: Iterable[ArrayLike], config: MappingConfig
) -> OccupancyGrid:
    """Makes the grid before the first view: the ball round each start is free, nothing else known.

    Args:
        bounds: box of the world, [2, 3] [m].
        starts: start poses, [4, 4] each; several cameras may start at several places.
        config: size of the cells and of the ball.
    """
    return mark_starts(empty_grid(bounds, config.cell_size), starts, config)


def mark_starts(
    grid: OccupancyGrid, starts: Iterable[ArrayLike], config: MappingConfig
) -> OccupancyGrid:
    """Marks the ball round each start as free."""
    # No image shows the ball around the start; without it the robot is in unknown space.
    for pose in starts:
        position = jnp.asarray(np.asarray(pose)[:3, 3], dtype=jnp.float32)
        grid = _mark_free_ball(grid, position, config.start_radius)
    return grid


def add_frame(
    map_state: MapState,
    grid: OccupancyGrid,
    frame: Frame,
    config: MappingConfig,
    *,
    donate: bool = False,
) -> tuple[MapState, OccupancyGrid]:
    """Adds a frame to a map and a grid, as `observe` does; the table grows.

    With `donate` the map must not be used again.
    """
    map_state = integrate_growing(
        map_state,
        frame,
        config.max_range,
        allow_growth=config.allow_growth,
        drop_edges=config.drop_edges,
        donate=donate,
    )
    # Depth before the body: free space of the body must not override hits of this frame.
    grid = _integrate_depth(grid, frame, config.max_range)
    position = np.asarray(frame.T_world_camera)[:3, 3]
    return map_state, _mark_free_ball(grid, position, config.body_radius)
