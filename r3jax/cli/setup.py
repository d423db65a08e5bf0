"""What an exploration needs, from the options of a new run or from the header of a recorded one."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from r3jax.cli.checks import DEFAULT_BUDGET, DEFAULT_POLICY, loop_of_options, motion_of_options
from r3jax.cli.options import Explore
from r3jax.exploration.budget import Budget, parse_budget
from r3jax.exploration.config import ExplorationConfig
from r3jax.exploration.replay import config_of, planner_config_of, policy_key
from r3jax.exploration.step import check_world
from r3jax.geometry.cameras import Camera, pose_along
from r3jax.planning.config import PlannerConfig
from r3jax.planning.motion import Motion
from r3jax.planning.policy import Policy
from r3jax.planning.registry import make_policy
from r3jax.scoring.config import ScoringConfig
from r3jax.simulators.base import Simulator
from r3jax.simulators.scenes.registry import open_scene, scene_hash
from r3jax.trace.errors import RunError
from r3jax.trace.header import RunHeader, camera_fields, package_versions, policy_fields
from r3jax.trace.reader import Run


@dataclass(frozen=True)
class Plan:
    """What is asked of an exploration, before its scene is opened."""

    budget: Budget
    config: ExplorationConfig
    policy: Policy


def plan_of_options(options: Explore) -> Plan:
    """A new run: everything but the scene.

    Raises:
        ValueError: a setting that cannot work.
    """
    config = loop_of_options(options)
    budget = parse_budget(options.budget or DEFAULT_BUDGET)
    policy = policy_of_options(options, options.max_range, motion_of_options(options))
    return Plan(budget, config, policy)


def policy_of_options(options: Explore, max_range: float, motion: Motion) -> Policy:
    """The policy that the options name, with the settings that they give.

    Args:
        options: of the command line.
        max_range: of the depth sensor [m].
        motion: what carries the camera.

    Raises:
        ValueError: an unknown policy, a setting that cannot work.
    """
    scoring = ScoringConfig(max_range=jnp.asarray(max_range, jnp.float32))
    if options.lambda1 is not None:
        lambda1 = jnp.asarray(options.lambda1, jnp.float32)
        scoring = eqx.tree_at(lambda config: config.lambda1, scoring, lambda1)
    settings: dict[str, Any] = {
        "scoring": scoring,
        "motion": motion,
        "num_candidates": options.candidates,
        "lambda2": options.lambda2,
        "refine": options.refine,
    }
    if options.candidates is not None:
        # Keeps the share that is aimed at the frontier, whatever the number.
        default = PlannerConfig()
        share = default.num_frontier / default.num_candidates
        settings["num_frontier"] = round(share * options.candidates)
    given = {name: value for name, value in settings.items() if value is not None}
    return make_policy(options.policy or DEFAULT_POLICY, **given)


def plan_of_run(run: Run) -> Plan:
    """A recorded run: what it was asked for.

    Raises:
        RunError: a policy or a setting that this version does not know.
    """
    header = run.header
    try:
        policy = make_policy(policy_key(run), **vars(planner_config_of(run)))
        return Plan(parse_budget(header.budget), config_of(run), policy)
    except RunError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise RunError(run.path / "run.json", f"the run cannot be set up again: {error}") from None


def simulator_of_options(options: Explore) -> Simulator:
    """The scene of a new run.

    Raises:
        ValueError: the scene is unknown, its file is refused, or it cannot be explored.
    """
    assert options.scene is not None
    simulator = open_scene(
        options.scene,
        up=options.up,
        scale=options.scale,
        cull_back_faces=options.cull_backfaces,
        camera=Camera.from_fov(options.resolution, options.resolution, options.fov),
        noise=options.noise,
        seed=options.seed,
        max_range=options.max_range,
        start_pose=_start_pose(options.start),
    )
    check_world(simulator.bounds, options.cell_size)  # before there is a folder
    return simulator


def simulator_of_run(run: Run) -> Simulator:
    """The scene of a recorded run.

    Raises:
        RunError: the scene is not the one that the run was recorded in.
        ValueError: the scene is unknown, or its file is refused.
    """
    scene = run.header.scene
    try:
        simulator = open_scene(
            scene["name"],
            **ways_to_open(scene),
            camera=run.camera,
            noise=scene["noise"],
            seed=run.header.seed,
            max_range=scene["max_range"],
            start_pose=_start_pose(scene["start"]),
        )
    except KeyError as error:
        raise RunError(run.path / "run.json", f"the scene lacks {error}") from None
    if scene_hash(simulator) != scene.get("hash"):
        raise RunError(
            run.path / "run.json",
            f"the scene {scene['name']} is not the one that the run was recorded in: its content "
            "has changed",
        )
    return simulator


def ways_to_open(scene: dict[str, Any]) -> dict[str, Any]:
    """How `open_scene` shows the scene of a header; older headers lack what there was not yet."""
    return {
        "up": scene.get("up"),
        "scale": scene.get("scale", 1.0),
        "cull_back_faces": scene.get("cull_backfaces", False),
    }


def header_of(options: Explore, plan: Plan, simulator: Simulator) -> RunHeader:
    """What fixes a new run."""
    names = ("up", "scale", "cull_backfaces", "noise", "max_range", "start")
    how = {name: getattr(options, name) for name in names}
    return RunHeader(
        scene={"name": options.scene, "hash": scene_hash(simulator), **how},
        policy=policy_fields(plan.policy),
        budget=str(plan.budget),
        seed=options.seed,
        config=dataclasses.asdict(plan.config),
        camera=camera_fields(simulator.camera),
        bounds=np.asarray(simulator.bounds).tolist(),
        packages=package_versions(),
    )


def _start_pose(start: Any) -> np.ndarray | None:
    """Looks along x from a start position [m]."""
    if start is None:
        return None
    pose = pose_along(jnp.asarray(start, jnp.float32), jnp.asarray([1.0, 0.0, 0.0]))
    return np.asarray(pose, dtype=np.float64)
