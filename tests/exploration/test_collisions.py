"""Whole runs with a noisy sensor never touch the mesh, which the planner has not seen."""

import numpy as np
import pytest

from r3jax.exploration import explore
from r3jax.exploration.config import ExplorationConfig
from r3jax.geometry.cameras import Camera
from r3jax.planning.registry import make_policy, policy_names
from r3jax.simulators.scenes import procedural
from r3jax.simulators.scenes.registry import open_scene

CONFIG = ExplorationConfig(clock="model", num_probes=1)
CLEARANCE = 0.25
"""Distance that the camera keeps from every surface [m]. The margin is 0.3 m round the centers of
cells known to be free; a surface may reach up to 5 cm into a cell before a hit marks it."""


def fly(scene: str, policy: str, views: int, seed: int = 0):
    """Explores a scene; returns the simulator and the flown segments [n, 2, 3] in meters."""
    simulator = open_scene(scene, camera=Camera.from_fov(128, 128, 60.0), noise=0.01, seed=seed)
    result = explore(
        simulator, make_policy(policy), budget=f"views:{views}", seed=seed, config=CONFIG
    )
    ways = [np.asarray(row.choice.waypoints) for row in result.rows if row.choice is not None]
    segments = [np.stack([way[:-1], way[1:]], axis=1) for way in ways if len(way) > 1]
    return simulator.simulator, np.concatenate(segments), result


def assert_no_collision(world, segments) -> None:
    for a, b in segments:
        assert world.segment_is_clear(a, b), f"the mesh lies between {a} and {b}"
    share = np.linspace(0.0, 1.0, 9)[None, :, None]
    points = segments[:, :1] * (1.0 - share) + segments[:, 1:] * share
    assert world.clearance(points.reshape(-1, 3)).min() >= CLEARANCE


@pytest.mark.full
@pytest.mark.parametrize(("scene", "policy"), [("flat", "r3-pano")])
def test_no_run_touches_the_mesh(scene, policy):
    world, segments, result = fly(scene, policy, views=16)
    assert len(result.rows) == 16
    assert np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1).sum() > 2.0
    assert_no_collision(world, segments)


@pytest.mark.full
def test_the_check_itself_finds_a_collision():
    world = open_scene("flat", camera=Camera.from_fov(16, 16, 60.0), noise=0.0)
    start = world.start_pose[:3, 3]
    outside = world.bounds[1] + 1.0
    with pytest.raises(AssertionError):
        assert_no_collision(world, np.stack([start, outside])[None])


@pytest.mark.slow
@pytest.mark.parametrize("policy", policy_names())
@pytest.mark.parametrize("scene", [n for n in procedural.names() if n != "tower"])
def test_no_long_run_touches_the_mesh(scene, policy):
    world, segments, _ = fly(scene, policy, views=60, seed=1)
    assert_no_collision(world, segments)
