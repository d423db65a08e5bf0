"""Climbs the smooth surrogate for the utility of a view, from many starts.

A view without roll is five numbers: a position, an azimuth and an elevation. What is allowed is a
box of them, on which projecting is exact: jaxopt's projected gradient, with a line search. Where
the position stays, nothing binds the two angles, and its L-BFGS turns the view.

Shape symbols: C starts.
"""

import functools
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r3jax.geometry.cameras import Camera, pose_along
from r3jax.mapping.state import MapState
from r3jax.scoring.batch import map_over_devices
from r3jax.scoring.cells import Cells
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.surrogate import Softness, Surrogate, soft_utility, surrogate_of

with warnings.catch_warnings():
    # It says on import that it is no longer developed; it does what is asked of it here.
    warnings.simplefilter("ignore", DeprecationWarning)
    import jaxopt

MAX_STEPS = 20
"""Steps of a climb; most end before."""

_TOLERANCE = 1e-2
"""A climb ends where the slope is smaller: shares of the start's utility per `_UNIT`."""

_UNIT = (0.3, 0.3, 0.3, 0.3, 0.3)
"""What counts as a step of the same size along each number of a view [m, m, m, rad, rad]."""


class Starts(eqx.Module):
    """Where climbs begin, and their bounds: of one, or of C."""

    position: Float[Array, "*C 3"]
    """Camera center [m]."""

    direction: Float[Array, "*C 3"]
    """Line of sight, of any length but 0."""

    low: Float[Array, "*C 3"]
    """Corner of the box of positions [m]."""

    high: Float[Array, "*C 3"]
    """Opposite corner [m]."""

    elevations: Float[Array, "*C 2"]
    """Lowest and highest angle of the line of sight above the horizon [rad]."""


class _Hill(eqx.Module):
    """What one climb needs to know."""

    around: Surrogate
    camera: Camera
    origin: Float[Array, " 5"]
    """The start's numbers."""

    least: Float[Array, ""]
    """Its utility, by which others are divided."""


def climb(
    voxels: MapState,
    cells: Cells,
    camera: Camera,
    config: ScoringConfig,
    starts: Starts,
    *,
    moves: bool = True,
) -> Float[Array, "C 5"]:
    """Where climbs end: positions [m], azimuths and elevations [rad]. Not to be called under jit.

    Args:
        voxels: what is known; `scoring.gather.gather_in_range` gathers it.
        cells: unexplored space, the same.
        camera: of the views.
        config: settings of the utility.
        starts: with fields of shape [C, ...].
        moves: False: turns only, whatever the boxes and elevations are.
    """
    run = _move if moves else _turn
    return map_over_devices(functools.partial(run, voxels, cells, camera, config), starts)


@jax.jit
def _move(
    voxels: MapState,
    cells: Cells,
    camera: Camera,
    config: ScoringConfig,
    starts: Starts,
) -> Float[Array, "C 5"]:
    look = functools.partial(_hill_of, voxels, cells, camera, config, moves=True)
    # One after the other: for some starts in an office, XLA's code for all at once never ended.
    return jax.lax.map(lambda start: _climb_in_box(look(start), start), starts)


@jax.jit
def _turn(
    voxels: MapState,
    cells: Cells,
    camera: Camera,
    config: ScoringConfig,
    starts: Starts,
) -> Float[Array, "C 5"]:
    look = functools.partial(_hill_of, voxels, cells, camera, config, moves=False)
    return jax.lax.map(lambda start: _climb_by_turning(look(start)), starts)


def _hill_of(
    voxels: MapState,
    cells: Cells,
    camera: Camera,
    config: ScoringConfig,
    start: Starts,
    *,
    moves: bool,
) -> _Hill:
    position, softness = start.position, Softness()
    pose = pose_along(position, start.direction)
    # Who only turns sees only what is in range of one place: far fewer voxels to keep.
    low, high = (start.low, start.high) if moves else (position, position)
    around = surrogate_of(voxels, cells, camera, pose, low, high, config, softness, moves=moves)
    # As in `Limits`: the azimuth of the image's level axis means something straight up, too.
    azimuth = jnp.arctan2(pose[0, 0], -pose[1, 0])
    elevation = jnp.arctan2(pose[2, 2], jnp.hypot(pose[0, 2], pose[1, 2]))
    origin = jnp.concatenate([position, jnp.stack([azimuth, elevation])])
    # Divided by the start, utilities of thousands and of tens meet one tolerance.
    least = soft_utility(around, camera, position, rotation_of(origin[3], origin[4]), softness)
    # Not by less than 1: a start that is worth nothing must not blow up the slope.
    return _Hill(around, camera, origin, jnp.maximum(least, 1.0))


def _climb_in_box(hill: _Hill, start: Starts) -> Float[Array, " 5"]:
    def depth(numbers: Float[Array, " 5"], hill: _Hill) -> Float[Array, ""]:
        return _depth(hill, hill.origin + unit * numbers)

    # Scaled so that a meter and a radian are steps of like effect to the solver.
    unit = jnp.asarray(_UNIT, dtype=jnp.float32)
    # The azimuth goes around in a circle: a bound on it would be a wall in one direction.
    anywhere = jnp.full(1, jnp.inf)
    lower = jnp.concatenate([start.low, -anywhere, start.elevations[:1]])
    upper = jnp.concatenate([start.high, anywhere, start.elevations[1:]])
    bounds = ((lower - hill.origin) / unit, (upper - hill.origin) / unit)
    solver = jaxopt.ProjectedGradient(
        depth,
        jaxopt.projection.projection_box,
        maxiter=MAX_STEPS,
        tol=_TOLERANCE,
        acceleration=False,
    )
    # From zero: the numbers are offsets from the start, so that float32 keeps its digits.
    found = solver.run(jnp.zeros(5), bounds, hill).params
    # Scaled back, the numbers may round past the box.
    return jnp.clip(hill.origin + unit * found, lower, upper)


def _climb_by_turning(hill: _Hill) -> Float[Array, " 5"]:
    def depth(angles: Float[Array, " 2"], hill: _Hill) -> Float[Array, ""]:
        return _depth(hill, turned(angles, hill))

    def turned(angles: Float[Array, " 2"], hill: _Hill) -> Float[Array, " 5"]:
        unit = jnp.asarray(_UNIT[3:], dtype=jnp.float32)
        return hill.origin.at[3:].add(unit * angles)

    solver = jaxopt.LBFGS(depth, maxiter=MAX_STEPS, tol=_TOLERANCE, history_size=4)
    return turned(solver.run(jnp.zeros(2), hill).params, hill)


def _depth(hill: _Hill, numbers: Float[Array, " 5"]) -> Float[Array, ""]:
    """How far below zero a view is: solvers go down."""
    R = rotation_of(numbers[3], numbers[4])
    return -soft_utility(hill.around, hill.camera, numbers[:3], R, Softness()) / hill.least


def rotation_of(azimuth: Float[Array, ""], elevation: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Axes, as columns, of a camera that looks there [rad] without roll."""
    level = jnp.cos(elevation)
    forward = jnp.stack([level * jnp.cos(azimuth), level * jnp.sin(azimuth), jnp.sin(elevation)])
    right = jnp.stack([jnp.sin(azimuth), -jnp.cos(azimuth), jnp.zeros_like(azimuth)])
    return jnp.stack([right, jnp.cross(forward, right), forward], axis=1)
