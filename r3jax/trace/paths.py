"""The path that the camera flew, by the rows of a trace.

Shape symbols: K, L waypoints.
"""

from collections.abc import Iterable, Iterator

import numpy as np

from r3jax.trace.rows import StepRow

_NOWHERE = np.zeros((0, 3))


def paths_to(rows: Iterable[StepRow]) -> Iterator[np.ndarray | None]:
    """Follows the path of the camera, row by row.

    Args:
        rows: of a trace, from the first one on.

    Yields:
        Waypoints from the row before to this one, [K, 3] float64 [m]; None where nothing was flown:
        at the start, and where another run of a merged one begins.
    """
    before: StepRow | None = None
    waypoints, begin = _NOWHERE, 0.0
    for row in rows:
        if before is None or row.begins_run:
            waypoints = _NOWHERE
            yield None
        else:
            if row.choice is not None:  # where frames are captured it stands in the first one's row
                waypoints, begin = row.choice.waypoints.astype(np.float64), before.metres
            piece = piece_of_path(waypoints, before.metres - begin, row.metres - begin)
            # Exactly from frame to frame: lengths along the path are rounded.
            piece[0], piece[-1] = before.pose[:3, 3], row.pose[:3, 3]
            yield piece
        before = row


def piece_of_path(waypoints: np.ndarray, begin: float, end: float) -> np.ndarray:
    """Cuts the piece between two lengths [m] out of a path over waypoints [K, 3], [L, 3] [m]."""
    if len(waypoints) < 2:
        return np.zeros((2, 3))
    steps = np.linalg.norm(np.diff(waypoints, axis=0), axis=1)
    done = np.concatenate([[0.0], np.cumsum(steps)])
    # Bends at the very ends of the piece are its ends.
    between = (done > begin + 1e-4) & (done < end - 1e-4)
    at = np.concatenate([[begin], done[between], [end]])
    return np.stack([np.interp(at, done, waypoints[:, axis]) for axis in range(3)], axis=1)
