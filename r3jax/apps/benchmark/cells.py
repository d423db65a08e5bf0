"""Defines a cell, the unit of work (scene x policy x seed under shared conditions), and its files.

All shared settings are in one place, `Conditions`, which makes a benchmark fair.
"""

import dataclasses
import functools
import hashlib
import json
import os
import re
import sys
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from r3jax.apps.benchmark.terms import ExplorationTerms, TrainingTerms
from r3jax.errors import InputError
from r3jax.exploration.config import Budget, ExplorationConfig, parse_budget
from r3jax.geometry.cameras import Camera
from r3jax.planning.config import FORMER_SETTINGS
from r3jax.planning.policies.foreign.commands import COMMAND, words_of
from r3jax.planning.policy import Policy
from r3jax.planning.registry import make_policy, policy_class
from r3jax.planning.robot.motion import Motion, make_motion, motion_of_record
from r3jax.runs.header import plain_settings, settings_of
from r3jax.scoring.config import RETIRED, ScoringConfig, scoring_config_of
from r3jax.splatting.backend import RasterConfig
from r3jax.splatting.training.config import TrainConfig

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

_SCORING = "scoring."
"""Prefix of the settings that go to `ScoringConfig`."""

OWN_OF_LOOP = ("voxel_size", "cell_size", "max_range", "capacity", "clock", "checkpoint_every")
"""Fields of `ExplorationConfig` that `Conditions` decides."""

_CHECKPOINT_EVERY = 25
"""Views between two checkpoints: frames and rows rebuild what comes after the last one."""

OWN_OF_TRAINER = ("iterations", "num_gaussians", "capacity", "raster", "seed")
"""The same of `TrainConfig`; the seed is the cell's."""


@dataclass(frozen=True, kw_only=True)
class Conditions(ExplorationTerms, TrainingTerms):
    """Budget, sensor, maps, clock, training and evaluating: the same for every policy.

    Raises:
        ValueError: a setting is invalid, or a snapshot is beyond the budget.
    """

    budget: str = "views:60"
    """Budget of every exploration: `views:N`, `seconds:S` or `meters:M`."""

    snapshots: tuple[str, ...] = ()
    """When a model is trained and evaluated, in any of these units; by default at the budget."""

    cell_size: float = 0.2
    """Edge of a cell of the coarse grid [m]."""

    map_capacity: int = 1 << 17
    """Rows of the map at the start, a power of two."""

    loop: dict[str, Any] = field(default_factory=dict[str, Any])
    """Further settings of `ExplorationConfig` by name; those at their defaults are left out."""

    trainer: dict[str, Any] = field(default_factory=dict[str, Any])
    """Further settings of `TrainConfig` by name; those at their defaults are left out."""

    def __post_init__(self) -> None:
        """Refuses invalid settings before the benchmark starts."""
        if not self.snapshots:
            object.__setattr__(self, "snapshots", (self.budget,))
        budget = parse_budget(self.budget)
        parsed = [parse_budget(text) for text in self.snapshots]
        for snapshot in parsed:
            if snapshot.unit == budget.unit and snapshot.amount > budget.amount:
                raise InputError(f"the snapshot {snapshot} lies beyond the budget {budget}")
        if len(set(parsed)) < len(parsed):
            raise InputError(f"a snapshot is given twice: {', '.join(self.snapshots)}")
        ExplorationTerms.__post_init__(self)
        TrainingTerms.__post_init__(self)
        if self.train_resolution > self.resolution:
            raise InputError(
                f"train_resolution {self.train_resolution} is more than the images have: "
                f"resolution is {self.resolution}"
            )
        object.__setattr__(self, "loop", _further(self.loop, ExplorationConfig, OWN_OF_LOOP))
        object.__setattr__(self, "trainer", _further(self.trainer, TrainConfig, OWN_OF_TRAINER))
        # Each refuses what it cannot work with.
        _ = self.exploration_config(), self.train_config(0)

    @property
    def camera(self) -> Camera:
        """Camera of every exploration, and of the test views before they are made smaller."""
        return Camera.from_fov(self.resolution, self.resolution, self.fov)

    def exploration_config(self) -> ExplorationConfig:
        """Returns the settings of the exploration loop."""
        return ExplorationConfig(
            voxel_size=self.voxel_size,
            cell_size=self.cell_size,
            max_range=self.max_range,
            capacity=self.map_capacity,
            clock=self.clock,
            checkpoint_every=_CHECKPOINT_EVERY,
            **self.loop,
        )

    def train_config(self, seed: int) -> TrainConfig:
        """Returns the settings of the training: vanilla 3DGS, the same for every policy."""
        return TrainConfig(
            iterations=self.iterations,
            num_gaussians=self.gaussians,
            capacity=self.capacity,
            raster=RasterConfig(backend=self.backend),
            seed=seed,
            **self.trainer,
        )

    def policy(self, name: str, settings: dict[str, Any]) -> Policy:
        """Creates a policy that scores views of this sensor.

        Args:
            name: one of `planning.registry.policy_names()`.
            settings: fields of `PlannerConfig`; `scoring.NAME` is a field of `ScoringConfig`,
                `motion` the name of a motion or its settings.

        Raises:
            ValueError: a name is unknown, or a value is invalid.
        """
        planner = {k: v for k, v in settings.items() if not k.startswith(_SCORING)}
        scoring: dict[str, Any] = {
            k.removeprefix(_SCORING): v for k, v in settings.items() if k not in planner
        }
        known = [field.name for field in fields(ScoringConfig)]
        unknown = [name for name in scoring if name not in known and name not in RETIRED]
        if unknown or "scoring" in planner:
            wrong = ", ".join(unknown) or "scoring"
            raise InputError(
                f"there is no setting {wrong} of the scores: give scoring.NAME, one of "
                f"{', '.join(known)}"
            )
        scoring = {"max_range": self.max_range} | scoring
        if "motion" in planner:
            planner["motion"] = _motion(planner["motion"])
        try:
            return make_policy(name, scoring=scoring_config_of(scoring), **planner)
        except TypeError as error:  # a text where a number belongs
            raise InputError(f"policy {name!r} with {settings}: {error}") from None


def _motion(given: Any) -> Motion:
    return make_motion(given) if isinstance(given, str) else motion_of_record(given)


def _further(given: dict[str, Any], config: type, own: tuple[str, ...]) -> dict[str, Any]:
    """Returns the given settings that are not a config's defaults, in the order of its fields."""
    known = {field.name: field.default for field in fields(config) if field.name not in own}
    unknown = [name for name in given if name not in known]
    if unknown:
        raise InputError(
            f"{config.__name__} has no further setting {', '.join(unknown)}; there are "
            f"{', '.join(known)}"
        )
    return {k: given[k] for k, default in known.items() if k in given and given[k] != default}


def snapshot_slug(snapshot: str) -> str:
    """Returns a snapshot as a part of file names: `views:30` becomes `views-30`."""
    return str(parse_budget(snapshot)).replace(":", "-")


def snapshot_order(snapshot: str) -> tuple[str, float]:
    """Sorts snapshots by unit, then by amount."""
    budget: Budget = parse_budget(snapshot)
    return budget.unit, budget.amount


@dataclass(frozen=True)
class Cell:
    """One exploration and the trainings on it. Small, as it is sent to other processes."""

    scene: str
    """Embedded scene by name, or `mesh:<file>`."""

    scene_hash: str
    """SHA-256 of the scene's content."""

    policy: str
    """The policy."""

    seed: int
    """Seed of exploration, sensor noise and training."""

    conditions: Conditions
    """Conditions that all cells share."""

    test_views_hash: str
    """Hash of the scene's test set."""

    num_test_views: int
    """Views in it."""

    settings: dict[str, Any] = field(default_factory=dict[str, Any])
    """Settings of the policy that differ from their defaults; see `Conditions.policy`."""

    up: str | None = None
    """Vertical axis of a mesh file; None: as its format has it."""

    scale: float = 1.0
    """Meters per unit of a mesh file. This and the next field are covered by the scene's hash."""

    cull_backfaces: bool = False
    """True to make faces invisible from behind."""

    submission: str | None = None
    """Hash of the submission whose frames are rendered again; None if the policy explores."""

    sources: dict[str, str] = field(default_factory=dict[str, str])
    """Result of `sources_of` the policy when the cell was planned."""

    @property
    def scene_name(self) -> str:
        """Name of the scene in tables; for a mesh file, without folder and suffix."""
        scene = self.scene.removeprefix("mesh:")
        return Path(scene).stem if scene != self.scene else scene

    @property
    def name(self) -> str:
        """Name of its folder: readable, and unique for each identity."""
        readable = re.sub(r"[^\w.-]+", "_", f"{self.scene_name}-{self.policy}")[:_LONGEST_NAME]
        return f"{readable}-seed{self.seed}-{self.identity_hash[:12]}"

    @functools.cached_property
    def identity_hash(self) -> str:
        """SHA-256 of all inputs that the results depend on."""
        text = json.dumps(identity(self), sort_keys=True, allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()


def identity(cell: Cell) -> dict[str, Any]:
    """Returns everything that the results of a cell depend on, as plain values.

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
        planner["motion"].pop("fixed_camera", None)  # only matters for frames captured while moving
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
        """Description of the cell for people."""
        return self.folder / "cell.json"

    @property
    def error(self) -> Path:
        """Reason of the last failure; absent if there was none."""
        return self.folder / "error.txt"

    def record(self, snapshot: str) -> Path:
        """Returns the path of a snapshot's result; the snapshot is done if this file exists."""
        return self.folder / f"snapshot-{snapshot_slug(snapshot)}.json"

    def checkpoints(self, snapshot: str) -> Path:
        """Returns the folder of a training in progress."""
        return self.folder / "training" / snapshot_slug(snapshot)

    def model(self, snapshot: str) -> Path:
        """Returns the path of the trained Gaussians."""
        return self.run / "models" / snapshot_slug(snapshot) / "scene.ply"


def paths_of(root: Path, cell: Cell) -> CellPaths:
    """Returns the paths of a cell's files in a benchmark's folder."""
    return CellPaths(Path(root) / "cells" / cell.name)


def snapshots_left(root: Path, cell: Cell) -> tuple[str, ...]:
    """Returns the snapshots that have no record yet."""
    paths = paths_of(root, cell)
    return tuple(s for s in cell.conditions.snapshots if not paths.record(s).exists())
