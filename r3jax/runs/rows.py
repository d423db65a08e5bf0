"""The rows of trace.jsonl: one per view, one for the end of the run; and their paths.

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
    """The reason in a sentence."""

    views: int
    """Number of recorded views."""


def to_json(row: StepRow | EndRow) -> str:
    """Writes one line of trace.jsonl, keys in a fixed order."""
    kind = "step" if isinstance(row, StepRow) else "end"
    plain = {"kind": kind, **dataclasses.asdict(row, dict_factory=_plain_dict)}
    if not plain.get("captured", True):
        del plain["captured"]  # as in rows of versions without captures
    if not plain.get("hidden", True):
        del plain["hidden"]  # as in rows of versions without planning while moving
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
    # The seal before the fields: a flipped digit is reported as damage, not as an odd number.
    plain = unsealed(plain)
    if plain.pop("kind") == "end":
        return build(EndRow, plain)
    # Arrays and nested records are made here; `build` only handles JSON's types.
    row = build(
        StepRow,
        plain,
        pose=rigid_pose("pose", plain.get("pose")),
        choice=None if plain.get("choice") is None else _choice(plain["choice"]),
        coverage=build(Coverage, plain.get("coverage")),
    )
    # It becomes a file name and an index, for which -1 would be the last.
    if row.step < 0:
        raise ForeignFileError(f"`step` must not be negative, got {row.step}")
    return row


def _choice(plain: Any) -> Choice:
    # `build` refuses what is not an object.
    known: dict[str, Any] = plain if isinstance(plain, dict) else {}
    waypoints = table_of("waypoints", known.get("waypoints"), (-1, 3))
    return build(
        Choice, plain, pose=rigid_pose("choice.pose", known.get("pose")), waypoints=waypoints
    )


def rigid_pose(name: str, values: Any) -> np.ndarray:
    """Makes a pose [4, 4] float32 from JSON.

    Raises:
        ForeignFileError: not a table of finite numbers, or not rigid; gives its `name`.
    """
    pose = table_of(name, values, (4, 4))
    # A matrix with scale or mirroring would still project, to wrong positions.
    problem = rigid_error(pose)
    if problem is not None:
        raise ForeignFileError(f"`{name}`: {problem}")
    return pose


def table_of(name: str, values: Any, shape: tuple[int, int]) -> np.ndarray:
    """Makes a float32 table from JSON; -1 allows any number of rows.

    Raises:
        ForeignFileError: not a table of finite numbers of that shape; gives its `name`.
    """
    try:
        with np.errstate(over="ignore"):  # too large for float32: found with the infinities
            found = np.asarray(values)
            # Checked first: a string such as "1" would become a number.
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
    """Converts to nested lists of the shortest decimals that give the same float32 numbers."""
    if array.ndim > 1:
        return [shortest_floats(part) for part in array]
    # str of a float32 is its shortest decimal; as a float64 it would have digits of noise.
    return [float(str(value)) for value in array.astype(np.float32)]


def _plain_dict(items: list[tuple[str, Any]]) -> dict[str, Any]:
    return {
        name: shortest_floats(value) if isinstance(value, np.ndarray) else value
        for name, value in items
    }


def paths_to(rows: Iterable[StepRow]) -> Iterator[np.ndarray | None]:
    """Yields the path of the camera, row by row.

    Args:
        rows: of a trace, from the first one on.

    Yields:
        Waypoints from the row before to this one, [K, 3] float64 [m]; None without a path: at the
        start, and at the start of each part of a merged run.
    """
    before: StepRow | None = None
    waypoints, begin = np.zeros((0, 3)), 0.0
    for row in rows:
        if before is None or row.begins_run:
            waypoints = np.zeros((0, 3))
            yield None
        else:
            if row.choice is not None:  # with captures it is in the row of the path's first frame
                waypoints, begin = row.choice.waypoints.astype(np.float64), before.metres
            piece = piece_of_path(waypoints, before.metres - begin, row.metres - begin)
            # Exactly from frame to frame, as lengths along the path are rounded.
            piece[0], piece[-1] = before.pose[:3, 3], row.pose[:3, 3]
            yield piece
        before = row


def piece_of_path(waypoints: np.ndarray, begin: float, end: float) -> np.ndarray:
    """Returns the piece between two lengths [m] of a path over waypoints [K, 3], [L, 3] [m]."""
    if len(waypoints) < 2:
        return np.zeros((2, 3))
    steps = np.linalg.norm(np.diff(waypoints, axis=0), axis=1)
    done = np.concatenate([[0.0], np.cumsum(steps)])
    # Bends at the very ends of the piece are its ends.
    between = (done > begin + 1e-4) & (done < end - 1e-4)
    at = np.concatenate([[begin], done[between], [end]])
    return np.stack([np.interp(at, done, waypoints[:, axis]) for axis in range(3)], axis=1)
