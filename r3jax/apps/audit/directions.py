"""Directions to a suggested view: from the nearest picture, in steps that a person would follow.

Shape symbols: n pictures.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from r3jax.apps.audit.suggest import Suggestion
from r3jax.captures.capture_maps import Seen
from r3jax.captures.source import Source, projected
from r3jax.captures.survey import Survey
from r3jax.kernels.robot.cells import segments_are_inside
from r3jax.mapping.occupancy import OccupancyGrid

_STEP = 0.1
"""Resolution of the steps in directions: a person cannot follow finer ones [m]."""

_TURN = 10.0
"""The same for turns [deg]."""

_SAME_PLACE = 0.3
"""Pictures up to this much farther away than the nearest one count as equally near
[audit units]."""

_BODY = (0.2, 0.5, 0.8)
"""Heights at which a body may meet an obstacle, as shares of the camera's height over the feet."""

_ROUND = 10.0
"""Length added to a straight line that is blocked [audit units]."""

_SHOWS = 0.3
"""Minimum share of a view that an image must show to help find the view."""

_SAMPLED = 500
"""Maximum number of voxels of a view that are searched for in other images."""

_NEAREST = 0.1
"""Near plane: points closer to a camera are not in its image [audit units]."""


@dataclass(frozen=True)
class Way:
    """Directions to a view from the place where a picture was taken."""

    start: int
    """Index of this picture in the capture."""

    text: str
    """The directions, one sentence."""

    turn: float
    """Angle to turn by, positive to the left [deg]."""

    is_blocked: bool
    """True if an obstacle stands between the picture's place and the view's."""

    target: int | None
    """Index of a picture that shows much of what the view shows; None if there is none."""


def spoken_length(length: float, unit: str) -> str:
    """Writes a length as it is spoken: 40 cm, 1.2 m; two digits if the unit is unknown.

    Args:
        length: length in the capture's unit.
        unit: `m`, or the name of an unknown unit.
    """
    if unit != "m":
        return f"{length:.2g} {unit}"
    rounded = max(_STEP, round(length / _STEP) * _STEP)
    return f"{100.0 * rounded:.0f} cm" if rounded < 0.95 else f"{rounded:.1f} m"


Order = Literal["forward", "aside", "straight"]
"""Order of the steps: forward or back first, to the side first, or straight to the place."""


def steps_between(
    here: np.ndarray,
    there: np.ndarray,
    meter: float,
    unit: str = "m",
    order: Order = "forward",
) -> list[str]:
    """Describes the steps from one view to another: walk, raise or lower the camera, turn, tilt.

    Forward and left refer to the horizontal heading of the current view. A view that looks straight
    up or down has the heading of the upper edge of its image.

    Args:
        here: `T_world_camera`, [4, 4], z up.
        there: pose of the view to take, in the same form.
        meter: length of one capture unit in the units of the poses.
        unit: name of the capture unit.
        order: order of the steps.
    """
    forward = _ahead(here)
    left = np.array([-forward[1], forward[0]])
    offset = (there[:3, 3] - here[:3, 3]) / meter
    # Without a metric scale the length of a step is unknown.
    least = max(0.5 * _STEP if unit == "m" else 0.0, 1e-6)
    moves = [
        f"{spoken_length(abs(amount), unit)} {forth if amount > 0 else back}"
        for amount, forth, back in (
            (float(offset[:2] @ forward), "forward", "back"),
            (float(offset[:2] @ left), "to the left", "to the right"),
        )
        if abs(amount) >= least
    ]
    is_straight = order == "straight" and len(moves) == 2
    if is_straight:
        bearing = float(np.degrees(np.arctan2(offset[:2] @ left, offset[:2] @ forward)))
        side = "left" if bearing > 0 else "right"
        length = spoken_length(float(np.hypot(*offset[:2])), unit)
        moves = [f"{length} straight, {_rounded(bearing):.0f}° to the {side} of {_THERE}"]
    elif order == "aside":
        moves.reverse()
    parts = [f"go {' and then '.join(moves)}"] if moves else []
    if abs(offset[2]) >= max(least, 1e-6):
        higher = "higher" if offset[2] > 0 else "lower"
        parts.append(f"hold the camera {spoken_length(abs(float(offset[2])), unit)} {higher}")
    turn, elevation = turn_between(here, there), _elevation(there)
    if abs(elevation) < 80.0:
        parts.append(_face_words(turn) if is_straight else _turn_words(turn))
    way = "up" if elevation > 0 else "down"
    tilt = f"{_rounded(elevation):.0f}° {way} from level"
    parts.append("hold it level" if abs(elevation) < 0.5 * _TURN else f"tilt it {tilt}")
    return parts


def turn_between(here: np.ndarray, there: np.ndarray) -> float:
    """Computes the horizontal angle between two views' axes, positive to the left [deg]."""
    forward, ahead = _ahead(here), _ahead(there)
    across = forward[0] * ahead[1] - forward[1] * ahead[0]
    return float(np.degrees(np.arctan2(across, forward @ ahead)))


def _ahead(pose: np.ndarray) -> np.ndarray:
    """Returns the heading of a view, [2]: its axis, or its upper edge if it looks up or down."""
    axis = pose[:3, 2] if np.hypot(*pose[:2, 2]) > 0.05 else -pose[:3, 1]
    return axis[:2] / np.hypot(*axis[:2])


def _elevation(pose: np.ndarray) -> float:
    return float(np.degrees(np.arcsin(np.clip(pose[2, 2], -1.0, 1.0))))


def _rounded(angle: float) -> float:
    return max(_TURN, round(abs(angle) / _TURN) * _TURN)


def _turn_words(turn: float) -> str:
    if abs(turn) < 0.5 * _TURN:
        return "do not turn"
    if abs(turn) > 165.0:
        return "turn round"
    side = "left" if turn > 0 else "right"
    if 80.0 <= abs(turn) <= 100.0:
        return f"turn a quarter to the {side}"
    return f"turn {_rounded(turn):.0f}° to the {side}"


def _face_words(turn: float) -> str:
    """Says where to turn after a straight walk, which changes the heading of the person."""
    if abs(turn) < 0.5 * _TURN:
        return f"face {_THERE}"
    return f"face {_rounded(turn):.0f}° to the {'left' if turn > 0 else 'right'} of {_THERE}"


_THERE = "the direction of that picture"


def way_to(source: Source, survey: Survey, seen: Seen, view: Suggestion) -> Way:
    """Describes the way to a view, from the nearest picture with an unobstructed line to it.

    Args:
        source: the capture.
        survey: the pictures used, and their poses in the audit.
        seen: free and occupied space.
        view: the view to take.
    """
    poses = survey.alignment.poses(source.poses[survey.chosen])
    nearest, is_blocked = _nearest(poses, seen.grid, view.pose, view.feet[2])
    here, meter = poses[nearest], survey.alignment.scale
    there = view.pose.copy()
    if view.is_over and np.isfinite(view.feet).all():
        there[:2, 3] = view.feet[:2]
    order = _order(here, there, seen.grid, view.feet[2])
    steps = steps_between(here, there, meter, survey.unit, order)
    if view.is_over:
        steps.insert(1 if len(steps) > 2 else 0, _reach(there, view.pose, meter, survey.unit))
    like, share = _likest_picture(source, survey, seen, view)
    target = like if share >= _SHOWS and source.has_images else None
    if target is not None and target != int(survey.chosen[nearest]):
        until = f"until you see the ringed surface of {source.labels[target]}"
        steps = [f"{s} {until}" if s.startswith(("turn", "face")) else s for s in steps]
    label = source.labels[int(survey.chosen[nearest])]
    parts = [f"Stand where you took {label}", *steps]
    text = f"{', '.join(parts[:-1])} and {parts[-1]}."
    if is_blocked:
        text += " Something stands between the two places: go round it."
    turn = turn_between(here, view.pose)
    return Way(int(survey.chosen[nearest]), text, turn, is_blocked, target)


def _reach(feet: np.ndarray, pose: np.ndarray, meter: float, unit: str) -> str:
    """Describes how far to hold the camera out over an obstacle."""
    out = float(np.linalg.norm(pose[:2, 3] - feet[:2, 3])) / meter
    return f"hold the camera {spoken_length(out, unit)} out over the obstacle there"


def _order(
    here: np.ndarray, there: np.ndarray, grid: OccupancyGrid, floor: float = np.nan
) -> Order:
    """Chooses an order of steps along which no obstacle is met, if there is one."""
    forward, start = _ahead(here), here[:3, 3]
    offset = there[:3, 3] - start
    ahead = np.array([*(offset[:2] @ forward * forward), 0.0])
    level = np.array([*offset[:2], 0.0])
    corners = {"forward": start + ahead, "aside": start + level - ahead}
    ends = np.stack([start, there[:3, 3]])
    for order, corner in corners.items():
        if not _is_blocked(grid, corner, ends, floor).any():
            return "forward" if order == "forward" else "aside"
    return "straight"


def _is_blocked(
    grid: OccupancyGrid, start: np.ndarray, ends: np.ndarray, floor: float = np.nan
) -> np.ndarray:
    """Finds which straight ways from a place [3] to others [n, 3] meet an obstacle, [n] bool.

    The camera does; over a known floor, the body below it, too.
    """
    origin, cell = np.asarray(grid.origin, np.float64), float(grid.cell_size)
    clear, blocked = ~np.asarray(grid.occupied), np.zeros(len(ends), bool)
    for share in (1.0, *_BODY) if np.isfinite(floor) else (1.0,):
        down = (1.0 - share) * np.array([0.0, 0.0, 1.0])
        a, b = (x + down * (np.nan_to_num(floor) - x[..., 2:]) for x in (start, ends))
        blocked |= ~segments_are_inside(clear, (a - origin) / cell, (b - origin) / cell)
    return blocked


def _nearest(
    poses: np.ndarray, grid: OccupancyGrid, there: np.ndarray, floor: float
) -> tuple[int, bool]:
    """Finds the nearest picture, by place and then by heading; True if the way is blocked."""
    eye, places = there[:3, 3], poses[:, :3, 3]
    is_blocked = _is_blocked(grid, eye, places, floor)
    distance = np.linalg.norm(places - eye, axis=1)
    # Who turns on the spot meets nothing, whatever cell the camera is in.
    is_blocked &= distance > float(grid.cell_size)
    cost = distance + _ROUND * is_blocked
    near = np.flatnonzero(cost <= cost.min() + _SAME_PLACE)
    turn = [abs(turn_between(poses[i], there)) for i in near.tolist()]
    best = int(near[int(np.argmin(turn))])
    return best, bool(is_blocked[best])


def _likest_picture(
    source: Source, survey: Survey, seen: Seen, view: Suggestion
) -> tuple[int, float]:
    """Finds the image with most of what a view shows, and the share of it [0, 1].

    Occlusion is ignored. Each radian between the two axes, and each unit of distance between the
    two places, costs a tenth of the share.
    """
    poses = survey.alignment.poses(source.poses[survey.chosen])
    distance = np.linalg.norm(poses[:, :3, 3] - view.pose[:3, 3], axis=1)
    angle = np.arccos(np.clip(poses[:, :3, 2] @ view.pose[:3, 2], -1.0, 1.0))
    centers = np.asarray(seen.state.center, np.float64).T[view.shown]
    centers = centers[:: max(1, len(centers) // _SAMPLED)]
    shares: list[float] = []
    for index, pose in zip(survey.chosen.tolist(), poses, strict=True):
        found = projected(source.camera(index), pose, centers, _NEAREST)
        shares.append(float(found.is_in.mean()) if len(centers) else 0.0)
    best = int(np.argmax(np.asarray(shares) - 0.1 * (distance + angle)))
    return int(survey.chosen[best]), shares[best]
