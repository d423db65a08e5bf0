"""The way from one view to another, in words that a person can follow."""

from collections.abc import Callable

import numpy as np


def steps_between(here: np.ndarray, there: np.ndarray, length: Callable[[float], str]) -> list[str]:
    """What to do to get from one view to another: go, hold higher, turn, look up.

    Forward and left are those of the view where one is, in the plane; a view that looks straight up
    or down is faced as its upper edge.

    Args:
        here: `T_world_camera`, [4, 4], z up.
        there: the same, of the view to take.
        length: writes a length of that world.
    """
    axis = here[:3, 2] if np.hypot(*here[:2, 2]) > 0.05 else -here[:3, 1]
    forward = axis[:2] / np.hypot(*axis[:2])
    offset = there[:3, 3] - here[:3, 3]
    ahead = float(offset[:2] @ forward)
    left = float(forward[0] * offset[1] - forward[1] * offset[0])
    moves = [
        f"{length(abs(amount))} {forth if amount > 0 else back}"
        for amount, forth, back in (
            (ahead, "forward", "back"), (left, "to the left", "to the right"),
        )
        if abs(amount) >= 0.05
    ]  # fmt: skip
    parts = [f"go {' and '.join(moves)}"] if moves else []
    if abs(offset[2]) >= 0.05:
        higher = "higher" if offset[2] > 0 else "lower"
        parts.append(f"hold the camera {length(abs(float(offset[2])))} {higher}")
    looks = there[:3, 2]
    elevation = np.degrees(np.arcsin(np.clip(looks[2], -1.0, 1.0)))
    if abs(elevation) < 80.0:
        turn = np.degrees(np.arctan2(forward[0] * looks[1] - forward[1] * looks[0],
                                     forward @ looks[:2]))  # fmt: skip
        side = "left" if turn > 0 else "right"
        parts.append(f"turn {abs(turn):.0f}° {side}" if abs(turn) >= 5.0 else "do not turn")
    way = "up" if elevation > 0 else "down"
    parts.append("look level" if abs(elevation) < 5.0 else f"look {abs(elevation):.0f}° {way}")
    return parts
