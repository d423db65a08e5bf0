"""The rows of trace.jsonl, one per view and one that says how the run ended, and their path.

Shape symbols: K, L waypoints.
"""

import dataclasses
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from r3jax.exploration.taken_views import Choice, Coverage, StepRow
from r3jax.geometry.cameras import rigid_error
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.json_text import build, parse_json, sealed, unsealed


@dataclass(frozen=True)
class EndRow:
    """How the run ended."""

    outcome: str
    """`budget`, `no-reachable-candidate`, `interrupted`, ...: `exploration.state.StopReason`."""

    message: str
    """The same in a sentence."""

    views: int
    """Views recorded."""


def to_json(row: StepRow | EndRow) -> str:
    """Writes one line of trace.jsonl, keys in a fixed order."""
    kind = "step" if isinstance(row, StepRow) else "end"
    plain = {"kind": kind, **dataclasses.asdict(row, dict_factory=_plain_dict)}
    if not plain.get("captured", True):
        del plain["captured"]  # as rows were before there were captures
    if not plain.get("hidden", True):
        del plain["hidden"]  # nor was there planning while moving
    # No blanks and a fixed order: under the model clock equal runs are equal bytes.
    return json.dumps(sealed(plain), allow_nan=False, separators=(",", ":"))


def from_json(line: str) -> StepRow | EndRow:
    """Parses a line that `to_json` wrote.

    Raises:
        ForeignFileError: the line is not a row; a field is missing, unknown or of another type; a
            number is not finite, a pose not rigid.
    """
    plain = parse_json(line)
    if not isinstance(plain, dict) or plain.get("kind") not in ("step", "end"):
        raise ForeignFileError("a row is an object with the kind `step` or `end`")
    # The seal comes before the fields: a flipped digit is told as damage, not as an odd number.
    plain = unsealed(plain)
    if plain.pop("kind") == "end":
        return build(EndRow, plain)
    # Arrays and nested records are made here, as `build` knows what JSON knows.
    row = build(
        StepRow,
        plain,
        pose=rigid_pose("pose", plain.get("pose")),
        choice=None if plain.get("choice") is None else _choice(plain["choice"]),
        coverage=build(Coverage, plain.get("coverage")),
    )
    # It becomes a file name and an index, where -1 would be the last.
    if row.step < 0:
        raise ForeignFileError(f"`step` must not be negative, got {row.step}")
    return row


def _choice(plain: Any) -> Choice:
    # What is no object is refused by `build`, which says so.
    known: dict[str, Any] = plain if isinstance(plain, dict) else {}
    waypoints = table_of("waypoints", known.get("waypoints"), (-1, 3))
    return build(
        Choice, plain, pose=rigid_pose("choice.pose", known.get("pose")), waypoints=waypoints
    )


def rigid_pose(name: str, values: Any) -> np.ndarray:
    """Makes a pose [4, 4] float32 of what JSON holds of it.

    Raises:
        ForeignFileError: no table of finite numbers, or not rigid; says which `name`.
    """
    pose = table_of(name, values, (4, 4))
    # A matrix that scales or mirrors would still project, to wrong places.
    problem = rigid_error(pose)
    if problem is not None:
        raise ForeignFileError(f"`{name}`: {problem}")
    return pose


def table_of(name: str, values: Any, shape: tuple[int, int]) -> np.ndarray:
    """Makes a table float32 of what JSON holds of it; -1 stands for any number of rows.

    Raises:
        ForeignFileError: no table of finite numbers of that shape; says which `name`.
    """
    try:
        with np.errstate(over="ignore"):  # too large for float32: found with the infinities
            found = np.asarray(values)
            # Checked first: a text such as "1" would become a number.
            if found.dtype.kind not in "iuf":
                raise TypeError(found.dtype)
            table = found.astype(np.float32)
    except (ValueError, TypeError):
        raise ForeignFileError(f"`{name}` must be a table of numbers") from None
    # An empty list has one axis; a path without waypoints has two.
    if table.size == 0 and shape[0] < 0:
        table = table.reshape(0, shape[1])
    if table.ndim != 2 or table.shape[1] != shape[1] or shape[0] not in (-1, len(table)):
        raise ForeignFileError(f"`{name}` has the shape {table.shape}, expected {shape}")
    if not np.isfinite(table).all():
        raise ForeignFileError(f"`{name}` has numbers that are not finite")
    return table


def shortest_floats(array: np.ndarray) -> list[Any]:
    """Makes nested lists of the shortest decimals that read back as the same float32 numbers."""
    if array.ndim > 1:
        return [shortest_floats(part) for part in array]
    # str of a float32 is its shortest decimal; as a float64 it would drag along digits of noise.
    return [float(str(value)) for value in array.astype(np.float32)]


def _plain_dict(items: list[tuple[str, Any]]) -> dict[str, Any]:
    return {
        name: shortest_floats(value) if isinstance(value, np.ndarray) else value
        for name, value in items
    }


def paths_to(rows: Iterable[StepRow]) -> Iterator[np.ndarray | None]:
    """Follows the path of the camera, row by row.

    Args:
        rows: of a trace, from the first one on.

    Yields:
        Waypoints from the row before to this one, [K, 3] float64 [m]; None where nothing was flown:
        at the start, and where another run of a merged one begins.
    """
    before: StepRow | None = None
    waypoints, begin = np.zeros((0, 3)), 0.0
    for row in rows:
        if before is None or row.begins_run:
            waypoints = np.zeros((0, 3))
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
