"""The settings that the library takes, from the options of a command line."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from r3jax.cli.checks import DEFAULT_BUDGET, DEFAULT_POLICY, loop_of_options, motion_of_options
from r3jax.cli.options import ExploreOptions
from r3jax.exploration.config import parse_budget
from r3jax.geometry.cameras import Camera
from r3jax.planning.config import PlannerConfig
from r3jax.planning.policy import Policy
from r3jax.planning.registry import make_policy
from r3jax.planning.robot.motion import Motion
from r3jax.runs.settings import RunSettings, SceneSettings
from r3jax.scoring.config import ScoringConfig


def run_settings(options: ExploreOptions) -> RunSettings:
    """Takes from the options of a new run everything but the scene.

    Raises:
        ValueError: a setting that cannot work.
    """
    config = loop_of_options(options)
    budget = parse_budget(options.budget or DEFAULT_BUDGET)
    policy = policy_of_options(options, options.max_range, motion_of_options(options))
    return RunSettings(budget, config, policy)


def policy_of_options(options: ExploreOptions, max_range: float, motion: Motion) -> Policy:
    """Makes the policy that the options name, with the settings that they give.

    Args:
        options: of the command line.
        max_range: reach of the depth sensor [m].
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


def scene_settings(options: ExploreOptions) -> SceneSettings:
    """Takes from the options of a new run how its scene is opened.

    Raises:
        ValueError: a camera that cannot be.
    """
    assert options.scene is not None
    return SceneSettings(
        options.scene,
        Camera.from_fov(options.resolution, options.resolution, options.fov),
        options.seed,
        noise=options.noise,
        max_range=options.max_range,
        up=options.up,
        scale=options.scale,
        cull_backfaces=options.cull_backfaces,
        start=options.start,
    )
