"""Settings of a run: of the loop, the policy and the scene, new or from a recorded header."""

import dataclasses
from dataclasses import dataclass, fields
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from r3jax.exploration.config import Budget, ExplorationConfig, parse_budget
from r3jax.geometry.cameras import Camera, pose_along
from r3jax.planning.config import FORMER_SETTINGS, PlannerConfig
from r3jax.planning.policy import Policy
from r3jax.planning.registry import config_class, make_policy
from r3jax.planning.robot.motion import motion_of_record
from r3jax.runs.header import RunError, RunHeader, camera_fields, package_versions, policy_fields
from r3jax.runs.reader import Run
from r3jax.scoring.config import scoring_config_of
from r3jax.simulators.base import Simulator
from r3jax.simulators.scenes.registry import open_scene, scene_hash


@dataclass(frozen=True)
class RunSettings:
    """Settings of an exploration, before its scene is opened."""

    budget: Budget
    config: ExplorationConfig
    policy: Policy

    def with_limits(self, budget: str | None, until: str | None) -> "RunSettings":
        """Replaces the budget or the goal if given.

        Raises:
            ValueError: an invalid budget or goal.
        """
        changed = self
        if budget is not None:
            changed = dataclasses.replace(changed, budget=parse_budget(budget))
        if until is not None:
            config = dataclasses.replace(changed.config, until=until)
            changed = dataclasses.replace(changed, config=config)
        return changed


def config_of(run: Run) -> ExplorationConfig:
    """Reads the settings of a run's loop.

    Raises:
        RunError: a setting that is unknown to this version, or invalid.
    """
    try:
        # Unknown settings may affect the map: they are refused, not ignored.
        return ExplorationConfig(**run.header.config)
    except (TypeError, ValueError) as error:
        raise RunError(run.path / "run.json", f"a setting of the loop: {error}") from None


def policy_key(run: Run) -> str:
    """Returns the name by which `make_policy` finds a run's policy, or the class of a plug-in.

    Raises:
        KeyError: the header has no name.
    """
    policy = run.header.policy
    return str(policy.get("class") or policy["name"])


def _config_class(run: Run) -> type[PlannerConfig]:
    """Finds the class of the settings of a run's policy.

    If the policy is not available, it is `PlannerConfig`.
    """
    try:
        return config_class(policy_key(run))
    except ValueError:  # retired, or of a package that is not installed here
        return PlannerConfig


def planner_config_of(run: Run) -> PlannerConfig:
    """Reads the settings of a run's policy.

    Raises:
        RunError: a setting that is unknown to this version, or invalid.
    """
    try:
        settings = dict(run.header.policy["settings"])
        scoring = scoring_config_of(settings.pop("scoring", {}))
        motion = motion_of_record(settings.pop("motion", None))
        kind = _config_class(run)
        # Runs of all policies once recorded settings of one: dropped for others.
        own = {field.name for field in fields(kind)}
        settings = {k: v for k, v in settings.items() if k in own or k not in FORMER_SETTINGS}
        return kind(scoring=scoring, motion=motion, **settings)
    except (KeyError, TypeError, ValueError) as error:
        raise RunError(run.path / "run.json", f"a setting of the policy: {error}") from None


def settings_of_run(run: Run) -> RunSettings:
    """Reads the settings of a recorded run.

    Raises:
        RunError: a policy or a setting that is unknown in this version.
    """
    header = run.header
    try:
        policy = make_policy(policy_key(run), **vars(planner_config_of(run)))
        return RunSettings(parse_budget(header.budget), config_of(run), policy)
    except RunError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise RunError(run.path / "run.json", f"the run cannot be set up again: {error}") from None


@dataclass(frozen=True)
class SceneSettings:
    """Settings for opening a scene, except the camera and the seed."""

    name: str
    """An embedded scene, or one of `outside_scenes`."""

    camera: Camera
    seed: int

    noise: float = 0.01
    """Standard deviation of the depth noise, relative to the depth."""

    max_range: float | None = 5.0
    """Range of the depth sensor [m]; None: unlimited."""

    up: Literal["y", "z"] | None = None
    """Vertical axis of a mesh file."""

    scale: float = 1.0
    """Unit of a mesh file [m]."""

    cull_backfaces: bool = False
    """Do not render back faces."""

    start: tuple[float, float, float] | None = None
    """Start position [m], looking along x; None: the scene's own, or found by a search."""

    def open(self) -> Simulator:
        """Opens the scene.

        Raises:
            ValueError: the scene is unknown, or its file is refused.
            ImportError: its simulator is not installed.
        """
        return open_scene(
            self.name,
            up=self.up,
            scale=self.scale,
            cull_back_faces=self.cull_backfaces,
            camera=self.camera,
            noise=self.noise,
            seed=self.seed,
            max_range=self.max_range,
            start_pose=None if self.start is None else _pose_at(self.start),
        )


_RECORDED = ("up", "scale", "cull_backfaces", "noise", "max_range", "start")
"""Fields of `SceneSettings` in a header, beside the name."""


def scene_of_run(run: Run) -> SceneSettings:
    """Reads the scene's settings of a recorded run.

    Raises:
        RunError: the header is incomplete.
    """
    scene = run.header.scene
    # Headers of earlier versions lack fields added since. # words: ok
    given: dict[str, Any] = {"up": None, "scale": 1.0, "cull_backfaces": False} | scene
    try:
        how: dict[str, Any] = {name: given[name] for name in _RECORDED}
        if how["start"] is not None:  # JSON only has lists
            how["start"] = tuple(how["start"])
    except KeyError as error:
        raise RunError(run.path / "run.json", f"the scene is missing {error}") from None
    return SceneSettings(scene["name"], run.camera, run.header.seed, **how)


def open_run_scene(run: Run) -> Simulator:
    """Opens the scene of a recorded run.

    Raises:
        RunError: the scene has changed.
        ValueError: the scene is unknown, or its file is refused.
    """
    settings = scene_of_run(run)
    simulator = settings.open()
    if scene_hash(simulator) != run.header.scene.get("hash"):
        raise RunError(
            run.path / "run.json",
            f"the scene {settings.name} is not the one that the run was recorded in: its content "
            "has changed",
        )
    return simulator


def new_header(settings: RunSettings, scene: SceneSettings, simulator: Simulator) -> RunHeader:
    """Makes the header of a new run.

    Args:
        settings: of the run.
        scene: settings of the scene.
        simulator: the scene, opened.
    """
    how = {name: getattr(scene, name) for name in _RECORDED}
    return RunHeader(
        scene={"name": scene.name, "hash": scene_hash(simulator), **how},
        policy=policy_fields(settings.policy),
        budget=str(settings.budget),
        seed=scene.seed,
        config=dataclasses.asdict(settings.config),
        camera=camera_fields(simulator.camera),
        bounds=np.asarray(simulator.bounds).tolist(),
        packages=package_versions(),
    )


def changed_versions(run: Run) -> list[str]:
    """Lists packages whose versions changed since the run began, as `jax 0.9 -> 0.10`."""
    now, then = package_versions(), run.header.packages
    return [f"{k} {then.get(k)} -> {v}" for k, v in now.items() if then.get(k) != v]


def _pose_at(start: Any) -> np.ndarray:
    """Returns `T_world_camera` [4, 4] at a position [m], looking along x."""
    pose = pose_along(jnp.asarray(start, jnp.float32), jnp.asarray([1.0, 0.0, 0.0]))
    return np.asarray(pose, dtype=np.float64)
