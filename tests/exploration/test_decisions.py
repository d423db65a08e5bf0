"""Whole runs decide as they did: the poses of ten recorded explorations, to 1e-5.

For changes that must not change anything. The poses were computed on one machine: another
processor rounds otherwise, and one candidate may win over its equal.

    pytest -m slow tests/exploration/test_decisions.py     compares
    python -m tests.exploration.test_decisions             records anew, on purpose
"""

from itertools import product
from pathlib import Path

import numpy as np
import pytest

from r3jax.exploration import explore
from r3jax.exploration.config import ExplorationConfig
from r3jax.geometry.cameras import Camera
from r3jax.planning.registry import make_policy
from r3jax.simulators.scenes.registry import open_scene

GOLDENS = Path(__file__).with_name("decisions.npz")
SCENES = ("flat", "apartment")
POLICIES = ("r3", "r3-pano", "r3-ahead", "active-gs", "frontier")
VIEWS = 25


def decide(scene: str, policy: str) -> np.ndarray:
    """Poses of a run's views, [25, 4, 4]."""
    simulator = open_scene(scene, camera=Camera.from_fov(64, 64), noise=0.01, seed=3)
    config = ExplorationConfig(clock="model", capacity=1 << 15, num_probes=1)
    result = explore(simulator, make_policy(policy), budget=f"views:{VIEWS}", seed=5, config=config)
    return np.stack([row.pose for row in result.rows])


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "policy"), list(product(SCENES, POLICIES)))
def test_every_pose_is_where_it_was(scene, policy):
    with np.load(GOLDENS) as goldens:
        expected = goldens[f"{scene}/{policy}"]
    poses = decide(scene, policy)
    assert len(poses) == VIEWS
    np.testing.assert_allclose(poses, expected, atol=1e-5)


if __name__ == "__main__":
    np.savez_compressed(
        GOLDENS,
        **{f"{scene}/{policy}": decide(scene, policy) for scene in SCENES for policy in POLICIES},
    )
