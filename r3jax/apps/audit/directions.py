"""Directions to a suggested view: from the nearest picture, in steps that a person would follow.

Shape symbols: n pictures.
"""

from dataclasses import dataclass

import numpy as np

from r3jax.apps.audit.suggest import Suggestion
from r3jax.captures.capture_maps import Seen
from r3jax.captures.source import Source, projected
from r3jax.captures.survey import Survey
from r3jax.kernels.robot.cells import segments_are_inside

_STEP = 0.1
"""A person follows steps of this, and no finer [m]."""

_TURN = 10.0
"""The same for turns [deg]."""

_SAME_PLACE = 0.3
"""Pictures so much farther away than the nearest one are as near to a person [audit units]."""

_ROUND = 10.0
"""A straight line that something blocks counts as so much longer [audit units]."""

_LANDMARK, _NEAR_BY = 25.0, 2.0
"""A picture shows where to turn to if its axis is within this angle [deg] of the view's, and it was
taken within this distance [audit units]."""

_SAMPLED = 500
"""Voxels of a view that are looked for in other images."""

_NEAREST = 0.1
"""What is nearer to a camera is not in its image [audit units]."""


@dataclass(frozen=True)
class Way:
    """How to get to a view from where a picture was taken."""

    start: int
    """The picture, in the capture's numbering."""

    text: str
    """What to do, one sentence."""

    turn: float
    """Angle to turn by, positive to the left [deg]."""

    is_blocked: bool
    """True if something stands between the picture's place and the view's."""


def spoken_length(length: float, unit: str) -> str:
    """Writes a length as one says it: 40 cm, 1.2 m; of an unknown unit to two digits.

    Args:
        length: in the capture's unit.
        unit: `m`, or another name of an unknown one.
    """
    if unit != "m":
        return f"{length:.2g} {unit}"
    rounded = max(_STEP, round(length / _STEP) * _STEP)
    return f"{100.0 * rounded:.0f} cm" if rounded < 0.95 else f"{rounded:.1f} m"


def steps_between(here: np.ndarray, there: np.ndarray, meter: float, unit: str = "m") -> list[str]:
    """Says how to get from one view to another: go, hold higher, turn, look up.

    Forward and left are those of the view where one is, in the plane; a view that looks straight up
    or down is faced as its upper edge.

    Args:
        here: `T_world_camera`, [4, 4], z up.
        there: the same, of the view to take.
        meter: one of the capture's units in the poses' units.
        unit: its name.
    """
    forward = _ahead(here)
    left = np.array([-forward[1], forward[0]])
    offset = (there[:3, 3] - here[:3, 3]) / meter
    # In a capture without meters nothing says what a step is.
    least = 0.5 * _STEP if unit == "m" else 0.0
    moves = [
        f"{spoken_length(abs(amount), unit)} {forth if amount > 0 else back}"
        for amount, forth, back in (
            (float(offset[:2] @ forward), "forward", "back"),
            (float(offset[:2] @ left), "to the left", "to the right"),
        )
        if abs(amount) >= max(least, 1e-6)
    ]
    parts = [f"go {' and '.join(moves)}"] if moves else []
    if abs(offset[2]) >= max(least, 1e-6):
        higher = "higher" if offset[2] > 0 else "lower"
        parts.append(f"hold the camera {spoken_length(abs(float(offset[2])), unit)} {higher}")
    turn, elevation = turn_between(here, there), _elevation(there)
    if abs(elevation) < 80.0:
        parts.append(_turn_words(turn))
    way = "up" if elevation > 0 else "down"
    tilt = f"{_rounded(elevation):.0f}° {way}"
    parts.append("hold it level" if abs(elevation) < 0.5 * _TURN else f"tilt it {tilt}")
    return parts


def turn_between(here: np.ndarray, there: np.ndarray) -> float:
    """Computes the angle in the plane between two views' axes, positive to the left [deg]."""
    forward, ahead = _ahead(here), _ahead(there)
    across = forward[0] * ahead[1] - forward[1] * ahead[0]
    return float(np.degrees(np.arctan2(across, forward @ ahead)))


def _ahead(pose: np.ndarray) -> np.ndarray:
    """Returns the axis of a view in the plane, [2]; if it looks up or down, its upper edge."""
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


def way_to(source: Source, survey: Survey, seen: Seen, view: Suggestion) -> Way:
    """Describes the way to a view, from the nearest picture that nothing stands before.

    Args:
        source: the capture.
        survey: which pictures were used, and where the audit has them.
        seen: free and occupied space.
        view: to be taken.
    """
    poses = survey.alignment.poses(source.poses[survey.chosen])
    nearest, is_blocked = _nearest(poses, seen, view)
    here, meter = poses[nearest], survey.alignment.scale
    there = view.pose.copy()
    if view.is_over and np.isfinite(view.feet).all():
        there[:2, 3] = view.feet[:2]
    steps = steps_between(here, there, meter, survey.unit)
    if view.is_over:
        steps.insert(1 if len(steps) > 2 else 0, _reach(there, view.pose, meter, survey.unit))
    landmark = _landmark(poses, view.pose, nearest)
    if landmark is not None:
        name = source.labels[int(survey.chosen[landmark])]
        steps = [f"{s} until you see what {name} shows" if s.startswith("turn") else s
                 for s in steps]  # fmt: skip
    label = source.labels[int(survey.chosen[nearest])]
    parts = [f"Stand where you took {label}", *steps]
    text = f"{', '.join(parts[:-1])} and {parts[-1]}."
    if is_blocked:
        text += " Something stands between the two places: go round it."
    return Way(int(survey.chosen[nearest]), text, turn_between(here, view.pose), is_blocked)


def _reach(feet: np.ndarray, pose: np.ndarray, meter: float, unit: str) -> str:
    """Describes a camera that is held over something."""
    out = float(np.linalg.norm(pose[:2, 3] - feet[:2, 3])) / meter
    return f"hold the camera {spoken_length(out, unit)} out over what stands there"


def _nearest(poses: np.ndarray, seen: Seen, view: Suggestion) -> tuple[int, bool]:
    """Finds the nearest picture, by place and then by heading; True if the line is blocked."""
    eye = view.pose[:3, 3]
    origin, cell = np.asarray(seen.grid.origin, np.float64), float(seen.grid.cell_size)
    is_blocked = ~segments_are_inside(
        ~np.asarray(seen.grid.occupied), (eye - origin) / cell, (poses[:, :3, 3] - origin) / cell
    )
    cost = np.linalg.norm(poses[:, :3, 3] - eye, axis=1) + _ROUND * is_blocked
    near = np.flatnonzero(cost <= cost.min() + _SAME_PLACE)
    turn = [abs(turn_between(poses[i], view.pose)) for i in near.tolist()]
    best = int(near[int(np.argmin(turn))])
    return best, bool(is_blocked[best])


def _landmark(poses: np.ndarray, pose: np.ndarray, start: int) -> int | None:
    """Finds a picture taken near by that looks where the view looks, or None."""
    angle = np.degrees(np.arccos(np.clip(poses[:, :3, 2] @ pose[:3, 2], -1.0, 1.0)))
    gap = np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=1)
    angle = np.where(gap <= _NEAR_BY, angle, np.inf)
    angle[start] = np.inf
    best = int(np.argmin(angle))
    return best if angle[best] <= _LANDMARK else None


def likest_picture(
    source: Source, survey: Survey, seen: Seen, view: Suggestion
) -> tuple[int, float]:
    """Finds the image with most of what a view shows, and the share of it [0, 1].

    What hides it is not asked. A radian between the two axes and a unit between the two places
    cost a tenth of the view each.
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
