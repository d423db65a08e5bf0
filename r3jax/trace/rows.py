"""The rows of trace.jsonl: one per view, and one that says how the run ended."""

import dataclasses
import json
import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from r3jax.geometry.cameras import rigid_error
from r3jax.planning.policy import Decision, PlanInfo
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.fields import build
from r3jax.validation.json_text import parse_json, sealed, unsealed

TOP_CANDIDATES = 10
"""Candidates of a decision that a row keeps, the best ones by total utility."""


@dataclass(frozen=True)
class Choice:
    """The decision that led to a view."""

    pose: np.ndarray
    """Chosen `T_world_camera`, [4, 4]."""

    score: float
    """Its utility."""

    waypoints: np.ndarray
    """Path of the camera center [m], [K, 3]."""

    length: float
    """Length of that path [m]."""

    num_candidates: int
    """Poses that were drawn."""

    num_reachable: int
    """Poses that a safe path leads to."""

    top: dict[str, list[float | None]] = field(default_factory=dict[str, list[float | None]])
    """Utilities of the best candidates, best first; None where one has no finite value."""


@dataclass(frozen=True)
class Coverage:
    """What the map and the grid know after a view. Not on the mission clock."""

    voxels: int
    """Occupied voxels of the map."""

    map_bytes: int
    """Memory of the map's rows, empty ones included [bytes]."""

    dropped: int
    """Observations lost so far because the table was full and might not grow."""

    known_cells: int
    """Coarse cells known to be free or occupied."""

    known_share: float
    """Known cells over all cells of the scene's box. The insides of walls and of furniture and
    what lies outside can never be seen, so it stays below 1."""

    frontier_cells: int
    """Unexplored cells that share a face with a free one: what is left to see."""

    mean_renderability: float
    """Mean renderability of a fixed sequence of probe views inside known free space."""

    arrival_renderability: float
    """Renderability of this very view just before it was integrated: how much it repeated."""


@dataclass(frozen=True)
class StepRow:
    """One view: where, why, at what cost, and what is known since."""

    step: int
    """Number of the view, from 0; names its images."""

    pose: np.ndarray
    """`T_world_camera`, [4, 4] float32."""

    sha256: str
    """Hash of the stored pixels."""

    choice: Choice | None
    """How the view was chosen; None for the start pose. Where frames are captured on the way, the
    decision stands in the first row of its path: what comes before a row is what was known when it
    was made."""

    seconds: float
    """Mission clock after the view: planning, mapping and flight [s]."""

    metres: float
    """Path flown so far [m]."""

    radians: float
    """Angle turned so far, along the shortest rotations [rad]."""

    charged: dict[str, float]
    """What this view added to the mission clock: `planning`, `mapping`, `flight`, `gaze` where it
    was captured on the way, and `exchange` where others told what they had seen [s]."""

    coverage: Coverage

    captured: bool = False
    """True if the frame was captured on the way to a view, and not chosen itself."""

    hidden: float = 0.0
    """Planning of this row's decision that the flight before it hid: not on the clock [s]."""

    @property
    def begins_run(self) -> bool:
        """True if the camera did not fly to the view: a run begins, be it within a merged one."""
        flown = self.choice is not None or self.captured or self.charged.get("flight", 0.0) > 0.0
        return not flown


def unit_of(rows: Iterable[StepRow]) -> str:
    """Names what rows count: views, or frames where some were captured on the way."""
    return "frames" if any(row.captured for row in rows) else "views"


@dataclass(frozen=True)
class EndRow:
    """How the run ended."""

    outcome: str
    """`budget`, `no-reachable-candidate`, `interrupted`, ...: `exploration.loop.StopReason`."""

    message: str
    """The same in a sentence."""

    views: int
    """Views recorded."""


def make_choice(decision: Decision, info: PlanInfo) -> Choice:
    """What the trace keeps of a decision."""
    total = np.asarray(decision.utilities.get("total", np.zeros(0)), dtype=np.float64)
    # Unreachable candidates have no utility; stable, so that equal ones keep the order of drawing.
    best = np.argsort(-np.where(np.isfinite(total), total, -np.inf), kind="stable")
    best = best[:TOP_CANDIDATES]
    top = {
        name: [finite_or_none(value) for value in np.asarray(values)[best]]
        for name, values in decision.utilities.items()
    }
    return Choice(
        pose=np.asarray(decision.T_world_camera, dtype=np.float32),
        score=float(decision.score),
        waypoints=np.asarray(decision.waypoints, dtype=np.float32),
        length=float(decision.length),
        num_candidates=info.num_candidates,
        num_reachable=info.num_reachable,
        top=top,
    )


def finite_or_none(value: float) -> float | None:
    """JSON knows neither inf nor NaN."""
    return float(value) if math.isfinite(value) else None


def to_json(row: StepRow | EndRow) -> str:
    """One line of trace.jsonl, keys in a fixed order."""
    kind = "step" if isinstance(row, StepRow) else "end"
    plain = {"kind": kind, **dataclasses.asdict(row, dict_factory=_plain_dict)}
    if not plain.get("captured", True):
        del plain["captured"]  # as rows were before there were captures
    if not plain.get("hidden", True):
        del plain["hidden"]  # nor was there planning on the way
    # No blanks and a fixed order: under the model clock equal runs are equal bytes.
    return json.dumps(sealed(plain), allow_nan=False, separators=(",", ":"))


def from_json(line: str) -> StepRow | EndRow:
    """Inverse of `to_json`.

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
    """Nested lists of the shortest decimals that read back as the same float32 numbers."""
    if array.ndim > 1:
        return [shortest_floats(part) for part in array]
    # str of a float32 is its shortest decimal; as a float64 it would drag along digits of noise.
    return [float(str(value)) for value in array.astype(np.float32)]


def _plain_dict(items: list[tuple[str, Any]]) -> dict[str, Any]:
    return {
        name: shortest_floats(value) if isinstance(value, np.ndarray) else value
        for name, value in items
    }
