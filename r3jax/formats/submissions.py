"""Submissions: an exploration as its poses, a JSON line each; all else is computed from these.

    {"format": "r3jax-submission", "version": 1, "protocol": 1, "scene": {...}, "seed": 0, ...}
    {"frame": 0, "pose": [[...], [...], [...], [...]], "seconds": 0.02}
    {"frame": 1, "pose": [[...], [...], [...], [...]], "seconds": 1.7}

The first line says on what terms the views were taken, each other line is a frame. Any program
that writes such a file can be judged by `r3jax benchmark --submission FILE`.

Shape symbols: K waypoints.
"""

import codecs
import dataclasses
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np

from r3jax.exploration.config import ExplorationConfig
from r3jax.exploration.state import COMPLETE
from r3jax.exploration.taken_views import StepRow
from r3jax.files import write_atomic
from r3jax.formats.errors import naming
from r3jax.geometry.cameras import Camera
from r3jax.planning.policies import HOMES, current_name
from r3jax.planning.robot.motion import Motion, motion_of_record
from r3jax.runs.header import RunError
from r3jax.runs.reader import Run
from r3jax.runs.replay import check_decided_alone
from r3jax.runs.rows import paths_to, rigid_pose, shortest_floats, table_of
from r3jax.runs.settings import SceneSettings, config_of, scene_of_run
from r3jax.validation.errors import ForeignFileError, check_version
from r3jax.validation.files import read_bytes
from r3jax.validation.json_text import build, check_fields, parse_json

FORMAT = "r3jax-submission"
"""What the first line says it is."""

VERSION = 1
"""Format version that this package writes."""

PROTOCOL = 1
"""Version of the rules that a submission keeps: sensor, clock, speed, clearance, test views."""

_MAX_BYTES = 16 << 20
"""A frame takes some hundred bytes; at ten frames a second this is an hour."""

_SCENE: dict[str, Any] = {
    "name": str, "hash": str, "up": str | None, "scale": float, "cull_backfaces": bool,
    "noise": float, "max_range": float,
}  # fmt: skip
"""How a scene is opened: its name and hash, and what a run's header has of it."""

_CAMERA: dict[str, Any] = {"width": int, "height": int} | dict.fromkeys(
    ("fx", "fy", "cx", "cy"), float
)

_LARGEST = {"capacity": 1 << 22, "num_bins": 1024, "num_probes": 1024}
"""Settings of the loop that a stranger's file could fill the memory with."""


@dataclass(frozen=True)
class SubmittedFrame:
    """One frame: where, when, and how the camera came there."""

    frame: int
    """Its number, from 0."""

    pose: np.ndarray
    """`T_world_camera`, [4, 4] float32."""

    seconds: float
    """Mission clock once the frame was taken and mapped [s]."""

    mapping: float = 0.0
    """Part of `seconds` that mapping took after the camera had arrived [s]."""

    metres: float | None = None
    """Path flown so far [m]; None: the sum of the paths."""

    path: np.ndarray | None = None
    """Waypoints from the frame before to this one, [K, 3] float32 [m]; None: a straight line."""

    captured: bool = False
    """True if the frame was captured while moving to a view, and not chosen itself."""

    sha256: str | None = None
    """Hash of the stored pixels (`exploration.taken_views.content_hash`); None: unknown."""

    @property
    def position(self) -> np.ndarray:
        """Camera center [3] float64 [m]."""
        return self.pose[:3, 3].astype(np.float64)


@dataclass(frozen=True)
class Submission:
    """The poses of one exploration, and the terms on which they were chosen."""

    scene: dict[str, Any]
    """`name`, `hash`, and how it is opened: `noise`, `max_range`, `up`, `scale`,
    `cull_backfaces`."""

    seed: int
    """Of the sensor's noise, of the start, and of the training."""

    budget: str
    """For example `views:60`."""

    camera: dict[str, int | float]
    """`width`, `height`, `fx`, `fy`, `cx`, `cy` [px]."""

    policy: dict[str, Any]
    """`name`, `version`, and further fields of its author."""

    frames: tuple[SubmittedFrame, ...]
    """In the order in which they were taken."""

    exploration: dict[str, Any] = field(default_factory=dict[str, Any])
    """Settings of the loop that differ from those of `ExplorationConfig`: clock, speed, ..."""

    motion: dict[str, Any] | None = None
    """How the camera moves, as in `Motion`; None: a camera that flies."""

    outcome: str = "budget"
    """Why the exploration ended: `exploration.state.StopReason`."""

    packages: dict[str, str] = field(default_factory=dict[str, str])
    """Versions of the software that chose the views."""

    @property
    def config(self) -> ExplorationConfig:
        """Settings of the loop.

        Raises:
            ValueError: one that cannot work.
        """
        return ExplorationConfig(**self.exploration | {"max_range": self.scene["max_range"]})

    @property
    def robot(self) -> Motion:
        """How the camera moves.

        Raises:
            ValueError: a setting that cannot work.
        """
        return motion_of_record(self.motion)

    @property
    def opened(self) -> SceneSettings:
        """How its scene is opened, and with which camera."""
        lens: dict[str, Any] = {name: self.camera[name] for name in _CAMERA}
        fields = {name: self.scene[name] for name in _SCENE if name != "hash"}
        return SceneSettings(camera=Camera(**lens), seed=self.seed, **fields)

    @property
    def name(self) -> str:
        """What tables call it: submitted, so that it stands beside the policy itself."""
        return f"{self.policy['name']} (submitted)"

    def paths(self) -> list[np.ndarray]:
        """Lists the waypoints to each frame, [K, 3] float64 [m]; the first has its place only."""
        found = [self.frames[0].position[None]]
        for before, frame in zip(self.frames, self.frames[1:], strict=False):
            straight = np.stack([before.position, frame.position])
            found.append(straight if frame.path is None else frame.path.astype(np.float64))
        return found


def submission_of_run(run: Run) -> Submission:
    """Takes the poses out of a recorded run.

    Raises:
        RunError: a run that is not over, or whose views are not one policy's.
    """
    header = run.header
    check_decided_alone(run)
    if header.parent is not None:
        raise RunError(run.path, "it is a fork: some of its views were chosen by another run")
    if run.end is None or run.end.outcome not in COMPLETE:
        raise RunError(
            run.path,
            f"it is incomplete ({run.outcome}): continue by `r3jax explore --resume {run.path}`",
        )
    given = dataclasses.asdict(config_of(run))
    default = dataclasses.asdict(ExplorationConfig())
    own = current_name(header.policy["name"]) in HOMES
    # Of the record itself: the policy may be of a package that is not installed here.
    motion = header.policy.get("settings", {}).get("motion")
    opened = vars(scene_of_run(run)) | {"hash": header.scene.get("hash")}
    return Submission(
        scene={name: opened[name] for name in _SCENE},
        seed=header.seed,
        budget=header.budget,
        camera=dict(header.camera),
        policy={
            "name": header.policy["name"],
            "version": f"r3jax {header.packages.get('r3jax', '')}" if own else "",
            "settings": header.policy.get("settings", {}),
        },
        frames=_frames_of(run.rows),
        exploration={
            name: value
            for name, value in given.items()
            if value != default[name] and name not in ("max_range", "checkpoint_every")
        },
        motion=motion,
        outcome=run.end.outcome,
        packages=header.packages,
    )


def _frames_of(rows: Sequence[StepRow]) -> tuple[SubmittedFrame, ...]:
    """Collects the frames of a trace, each with the piece of the path that leads to it."""
    return tuple(
        SubmittedFrame(
            frame=row.step,
            pose=row.pose,
            seconds=row.seconds,
            mapping=row.charged.get("mapping", 0.0),
            metres=row.metres,
            path=None if path is None or len(path) == 2 else path,  # straight
            captured=row.captured,
            sha256=row.sha256,
        )
        for row, path in zip(rows, paths_to(rows), strict=True)
    )


def write_submission(path: Path, submission: Submission) -> None:
    """Writes the file: whole, or not at all.

    Raises:
        OSError: the disk is full, not writable, ...
    """
    write_atomic(path, submission_text(submission).encode())


def submission_text(submission: Submission) -> str:
    """Writes the lines of the file."""
    first = {"format": FORMAT, "version": VERSION, "protocol": PROTOCOL} | vars(submission)
    del first["frames"]
    lines = [first, *(_plain(frame) for frame in submission.frames)]
    return "".join(
        json.dumps(line, allow_nan=False, separators=(",", ":")) + "\n" for line in lines
    )


def _plain(frame: SubmittedFrame) -> dict[str, Any]:
    """Converts a frame to plain JSON values, without those at their defaults."""
    plain = {
        item.name: getattr(frame, item.name)
        for item in dataclasses.fields(SubmittedFrame)
        if item.name in ("pose", "path") or getattr(frame, item.name) != item.default
    }
    return {
        name: shortest_floats(value) if isinstance(value, np.ndarray) else value
        for name, value in plain.items()
        if value is not None
    }


def read_submission(path: Path) -> Submission:
    """Reads a submission.

    Raises:
        FormatError: missing, not a submission, of another version or protocol; a field that is
            missing, unknown or of another type; a pose that is not rigid; frames that are doubled
            or out of order. Says which line.
    """
    with naming(path):
        return parse_submission(read_bytes(path, _MAX_BYTES))


def parse_submission(data: bytes) -> Submission:
    """Reads the lines of a submission.

    Raises:
        ForeignFileError: as `read_submission` says.
    """
    text = data.removeprefix(codecs.BOM_UTF8).rstrip()
    header = dict[str, Any]()
    frames: list[SubmittedFrame] = []
    for number, line in enumerate(text.split(b"\n"), start=1):
        try:
            if number == 1:
                header = _header_of(parse_json(line))
            else:
                frames.append(_frame_of(parse_json(line), len(frames)))
        except ForeignFileError as error:
            raise ForeignFileError(f"line {number}: {error}") from None
    if not frames:
        raise ForeignFileError("there are no frames: each takes a line after the first one")
    return build(Submission, header, frames=tuple(frames))


def _header_of(plain: Any) -> dict[str, Any]:
    """Reads the fields of the first line, except for format and versions."""
    if not isinstance(plain, dict) or plain.get("format") != FORMAT:
        raise ForeignFileError(f"this is not a submission (no format {FORMAT!r})")
    check_version(plain.get("version"), VERSION)
    protocol = plain.get("protocol")
    if type(protocol) is not int or protocol != PROTOCOL:  # True equals 1
        raise ForeignFileError(
            f"protocol {protocol!r:.20}, this package uses protocol {PROTOCOL}: "
            "export the run again, or use the r3jax of that protocol"
        )
    fields = {k: v for k, v in plain.items() if k not in ("format", "version", "protocol")}
    header = build(Submission, fields, frames=())  # types, missing and unknown names
    _check_parts(header)
    return fields


def _check_parts(header: Submission) -> None:
    """Refuses what the types of the fields alone do not tell."""
    check_fields("scene", header.scene, _SCENE)
    check_fields("camera", header.camera, _CAMERA)
    check_fields("policy", header.policy, {"name": str, "version": str})
    if header.outcome not in COMPLETE:
        raise ForeignFileError(f"`outcome` must be one of {', '.join(sorted(COMPLETE))}")
    settings = {"exploration": (header.exploration, ExplorationConfig)}
    for name, (plain, kind) in (settings | {"motion": (header.motion or {}, Motion)}).items():
        hints = get_type_hints(kind)
        if unknown := sorted(plain.keys() - hints.keys()):
            raise ForeignFileError(f"`{name}` has an unknown {unknown[0]!r:.80}")
        check_fields(name, plain, {field: hints[field] for field in plain})
    for name, largest in _LARGEST.items():
        if header.exploration.get(name, 0) > largest:
            raise ForeignFileError(f"`exploration.{name}` is more than {largest}")
    try:
        _ = header.config, header.robot, header.opened
    except ValueError as error:
        raise ForeignFileError(str(error)) from None


def _frame_of(plain: Any, number: int) -> SubmittedFrame:
    """Reads a frame from its line; `number` is that of the next frame."""
    known: dict[str, Any] = plain if isinstance(plain, dict) else {}
    if known and known.get("pose") is None:
        raise ForeignFileError("the frame is missing `pose`")
    ready: dict[str, Any] = {"pose": rigid_pose("pose", known.get("pose"))}
    if known.get("path") is not None:
        ready["path"] = table_of("path", known["path"], (-1, 3))
    frame = build(SubmittedFrame, plain, **ready)
    if frame.frame != number:
        raise ForeignFileError(f"expected frame {number}, found frame {frame.frame}")
    if frame.path is not None and len(frame.path) < 2:
        raise ForeignFileError("`path` needs at least two waypoints: its start and its end")
    return frame


def content_hash(submission: Submission) -> str:
    """Hashes the content of a submission by SHA-256, without the paths of files."""
    # The scene is known by the hash of what it shows, not by its name.
    nowhere = dataclasses.replace(submission, scene=submission.scene | {"name": ""})
    return hashlib.sha256(submission_text(nowhere).encode()).hexdigest()
