"""The unit of work: scene x policy x seed under given conditions, and where its results lie."""

import dataclasses
import functools
import hashlib
import json
import os
import re
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from r3jax.apps.benchmark.conditions import Conditions, snapshot_slug
from r3jax.planning.config import FORMER_SETTINGS
from r3jax.planning.policies.foreign.commands import COMMAND, words_of
from r3jax.planning.registry import policy_class
from r3jax.runs.header import plain_settings, settings_of

IDENTITY_VERSION = 1
"""Raised when results of an older version of this package must not be taken over."""

_LONGEST_NAME = 150
"""Of a cell's folder, before what tells it from others; file systems take 255 characters."""

_LATER = {
    "drop_edges": True,
    "capture_every": None, "capture_rate": None, "gaze": "panorama", "exposure": 0.0, "blur": 1.0,
    "plan_while_moving": False, "planning_seconds": 0.3, "mapping_seconds": 0.02,
}  # fmt: skip
"""Settings of the loop that came after the first cells, with the values that these had: they count
only where they differ, so that what was done before stays done."""


@dataclass(frozen=True)
class Cell:
    """One exploration and what is trained on it. Small: it travels to other processes."""

    scene: str
    """Embedded scene by name, or `mesh:<file>`."""

    scene_hash: str
    """SHA-256 of what the scene shows."""

    policy: str
    """Who chooses the views."""

    seed: int
    """Seed of exploration, sensor noise and training."""

    conditions: Conditions
    """What all cells have in common."""

    test_views_hash: str
    """Hash of the scene's test set."""

    num_test_views: int
    """Views in it."""

    settings: dict[str, Any] = field(default_factory=dict[str, Any])
    """Settings of the policy that differ from their defaults; see `Conditions.policy`."""

    up: str | None = None
    """Vertical axis of a mesh file; None: as its format has it."""

    scale: float = 1.0
    """Metres in a unit of a mesh file. It and the next count with the scene's hash."""

    cull_backfaces: bool = False
    """Whether faces seen from behind are not there."""

    submission: str | None = None
    """Hash of the submission whose frames are taken again; None: the policy explores."""

    sources: dict[str, str] = field(default_factory=dict[str, str])
    """What `sources_of` the policy was when the cell was planned."""

    @property
    def scene_name(self) -> str:
        """What tables call the scene: a mesh file without folder and suffix."""
        scene = self.scene.removeprefix("mesh:")
        return Path(scene).stem if scene != self.scene else scene

    @property
    def name(self) -> str:
        """Name of its folder: readable, and another one for everything that differs."""
        readable = re.sub(r"[^\w.-]+", "_", f"{self.scene_name}-{self.policy}")[:_LONGEST_NAME]
        return f"{readable}-seed{self.seed}-{self.identity_hash[:12]}"

    @functools.cached_property
    def identity_hash(self) -> str:
        """SHA-256 of everything that the results depend on."""
        text = json.dumps(identity(self), sort_keys=True, allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()


def identity(cell: Cell) -> dict[str, Any]:
    """Everything that the results of a cell depend on, as plain values.

    Settings of the policy and of the training count with their defaults, so that a changed
    default is another cell. Snapshots do not count: each has its own record.
    """
    conditions = dataclasses.asdict(cell.conditions)
    for name in ("snapshots", "loop", "trainer"):  # the latter are among those that they are of
        del conditions[name]
    exploration = dataclasses.asdict(cell.conditions.exploration_config())
    planner: dict[str, Any] = {}
    if cell.submission is None:
        policy = cell.conditions.policy(cell.policy, cell.settings)
        # What was done before a policy had settings of its own stays done.
        planner = FORMER_SETTINGS | settings_of(policy)
    if not cell.conditions.exploration_config().captures and "motion" in planner:
        planner["motion"].pop("fixed_camera", None)  # it decides on frames on the way alone
    return {
        "version": IDENTITY_VERSION,
        "scene": cell.scene_hash,
        "policy": cell.policy,
        "planner": planner,
        "given": plain_settings(cell.settings),
        "seed": cell.seed,
        "conditions": conditions,
        "exploration": {k: v for k, v in exploration.items() if (k, v) not in _LATER.items()},
        "training": cell.conditions.train_config(cell.seed).as_record(),
        "test_views": {"hash": cell.test_views_hash, "count": cell.num_test_views},
    } | {name: value for name in ("submission", "sources") if (value := getattr(cell, name))}


def sources_of(policy: str) -> dict[str, str]:
    """Finds the SHA-256 of the files that the rule of a policy is in, by what names them.

    These are the words of a command that are files, or the module of a class; what they import in
    turn is not followed. None for a policy of this package.

    Raises:
        ValueError: there is no such policy.
        OSError: a file cannot be read.
    """
    if policy.startswith(COMMAND):
        files = {word: word for word in words_of(policy.removeprefix(COMMAND))}
    else:
        module = policy_class(policy).__module__
        if module.partition(".")[0] == "r3jax":
            return {}
        files = {module: getattr(sys.modules[module], "__file__", None) or ""}
    # Not `Path.is_file`, which raises for a word that no file can be called, such as a program.
    return {name: _file_hash(path) for name, path in files.items() if os.path.isfile(path)}


def _file_hash(path: str) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@dataclass(frozen=True)
class CellPaths:
    """The files of a cell."""

    folder: Path

    @property
    def run(self) -> Path:
        """The run folder of the exploration."""
        return self.folder / "run"

    @property
    def identity(self) -> Path:
        """What the cell is, for the reader."""
        return self.folder / "cell.json"

    @property
    def error(self) -> Path:
        """Why it failed last time; absent if it did not."""
        return self.folder / "error.txt"

    def record(self, snapshot: str) -> Path:
        """The result of one snapshot: it is done if this file is there."""
        return self.folder / f"snapshot-{snapshot_slug(snapshot)}.json"

    def checkpoints(self, snapshot: str) -> Path:
        """Folder of a training that is under way."""
        return self.folder / "training" / snapshot_slug(snapshot)

    def model(self, snapshot: str) -> Path:
        """The trained Gaussians."""
        return self.run / "models" / snapshot_slug(snapshot) / "scene.ply"


def paths_of(root: Path, cell: Cell) -> CellPaths:
    """Where the files of a cell lie in a benchmark's folder."""
    return CellPaths(Path(root) / "cells" / cell.name)


def snapshots_left(root: Path, cell: Cell) -> tuple[str, ...]:
    """The snapshots that have no record yet."""
    paths = paths_of(root, cell)
    return tuple(s for s in cell.conditions.snapshots if not paths.record(s).exists())
