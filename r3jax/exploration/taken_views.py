"""Taken views: the stored form of a frame, and its row in the trace.

The map integrates the recorded data: the loop rounds a frame to its stored form (8-bit color,
16-bit depth) *before* it enters the map, so that a map rebuilt from the files is the same map, bit
for bit.

Shape symbols: H, W image size; K waypoints.
"""

import hashlib
import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import jax.numpy as jnp
import numpy as np

from r3jax.exploration.config import BEYOND_RANGE, DEPTH_STEPS_PER_METRE
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.planning.policy import Decision, PlanInfo

TOP_CANDIDATES = 10
"""Number of candidates of a decision kept in a row: the best by total utility."""


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
    """Number of poses drawn."""

    num_reachable: int
    """Number of reachable poses."""

    top: dict[str, list[float | None]] = field(default_factory=dict[str, list[float | None]])
    """Utilities of the best candidates, best first; None for values that are not finite."""


@dataclass(frozen=True)
class Coverage:
    """Coverage of map and grid after a view. Not on the mission clock."""

    voxels: int
    """Number of voxels in the map."""

    map_bytes: int
    """Memory of the map's rows, including empty ones [bytes]."""

    dropped: int
    """Number of observations dropped so far because the table was full and could not grow."""

    known_cells: int
    """Number of coarse cells known to be free or occupied."""

    known_share: float
    """Share of known cells of the scene's box. The insides of walls and furniture and the outside
    can never be seen, so it stays below 1."""

    frontier_cells: int
    """Number of unexplored cells next to a free one."""

    mean_renderability: float
    """Mean renderability of a fixed sequence of probe views inside known free space; in a run with
    tiles, of those round the camera."""

    arrival_renderability: float
    """Renderability of this view just before it was integrated; high if it repeats others."""


@dataclass(frozen=True)
class StepRow:
    """The record of one view: its pose, its choice, its cost, and the coverage after it."""

    step: int
    """Number of the view, from 0, also in the names of its images."""

    pose: np.ndarray
    """`T_world_camera`, [4, 4] float32."""

    sha256: str
    """Hash of the stored pixels."""

    choice: Choice | None
    """How the view was chosen; None for the start pose. If frames are captured while moving, the
    decision is in the first row of its path, so that the rows before it are those on which it was
    made."""

    seconds: float
    """Mission clock after the view: planning, mapping and flight [s]."""

    metres: float
    """Path flown so far [m]."""

    radians: float
    """Angle turned so far, along the shortest rotations [rad]."""

    charged: dict[str, float]
    """Time that this view added to the mission clock, by stage: `planning`, `mapping`, `flight`,
    `gaze` if it was captured while moving, and `exchange` if frames of other cameras were received
    [s]."""

    coverage: Coverage

    captured: bool = False
    """True if the frame was captured while moving."""

    hidden: float = 0.0
    """Planning time of this row's decision hidden by the flight before it; not on the clock [s]."""

    @property
    def begins_run(self) -> bool:
        """True for the first view of a run, also within a merged run."""
        flown = self.choice is not None or self.captured or self.charged.get("flight", 0.0) > 0.0
        return not flown


def unit_of(rows: Iterable[StepRow]) -> str:
    """Returns the unit of rows: views, or frames if some were captured while moving."""
    return "frames" if any(row.captured for row in rows) else "views"


def name_of(row: StepRow, rows: Iterable[StepRow]) -> str:
    """Names a row by its number: `view 3`, or `frame 12` in runs with frames between views."""
    return f"{unit_of(rows)[:-1]} {row.step + 1}"


@dataclass(frozen=True)
class TakenView:
    """A taken view: everything to record beside the state."""

    row: StepRow
    frame: Frame
    """In stored form."""

    stages: dict[str, float] = field(default_factory=dict[str, float])
    """Measured times of the stages, including those not on the mission clock [s]."""

    decision: Decision | None = None
    """The decision that led here, with all candidates; None: no decision since the frame before."""


def make_choice(decision: Decision, info: PlanInfo) -> Choice:
    """Makes the record of a decision."""
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
    """Replaces inf and NaN, which JSON cannot contain, by None."""
    return float(value) if math.isfinite(value) else None


def to_integers(frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Converts a frame to color [H, W, 3] uint8 and depth [H, W] uint16 in steps of 0.2 mm."""
    rgb = np.rint(np.asarray(frame.rgb) * np.float32(255.0)).astype(np.uint8)
    depth = np.asarray(frame.depth)
    # inf has no integer: it gets its own value below.
    finite = np.where(np.isfinite(depth), depth, 0.0)
    # In float64 the product is exact; float32 would round it once more, before `rint` does.
    steps = np.rint(finite.astype(np.float64) * DEPTH_STEPS_PER_METRE)
    # A surface closer than half a step is still a surface, not a missing measurement.
    steps = np.where((finite > 0.0) & (steps < 1.0), 1.0, steps)
    steps = np.where(np.isinf(depth), BEYOND_RANGE, np.minimum(steps, BEYOND_RANGE))
    return rgb, steps.astype(np.uint16)


def from_integers(
    rgb: np.ndarray, depth: np.ndarray, T_world_camera: np.ndarray, camera: Camera
) -> Frame:
    """Makes a frame from stored images: the inverse of `to_integers`."""
    metres = depth.astype(np.float32) / np.float32(DEPTH_STEPS_PER_METRE)
    return Frame(
        rgb=jnp.asarray(rgb.astype(np.float32) / np.float32(255.0)),
        depth=jnp.asarray(np.where(depth == BEYOND_RANGE, np.float32(np.inf), metres)),
        T_world_camera=jnp.asarray(T_world_camera, dtype=jnp.float32),
        camera=camera,
    )


def stored_form(frame: Frame) -> Frame:
    """Rounds a frame to its stored form: 8-bit color and 0.2 mm of depth."""
    rgb, depth = to_integers(frame)
    return from_integers(rgb, depth, np.asarray(frame.T_world_camera), frame.camera)


def content_hash(rgb: np.ndarray, depth: np.ndarray) -> str:
    """Computes SHA-256 over the stored pixels; it does not depend on the PNG compressor."""
    digest = hashlib.sha256(np.ascontiguousarray(rgb).tobytes())
    # Little-endian by name: the hash must be the same on every machine.
    digest.update(np.ascontiguousarray(depth).astype("<u2").tobytes())
    return digest.hexdigest()


def frame_hash(frame: Frame) -> str:
    """Computes `content_hash` of a frame."""
    return content_hash(*to_integers(frame))
