"""A 512x512 RGB-D frame of a furnished house with 146 000 textured triangles: at most 150 ms."""

import numpy as np
import pytest

from r3jax.simulators.meshes import load_world
from r3jax.simulators.raycast.raycast import RaycastSimulator
from tests.simulators.habitat.habitat_golden import HOUSE

pytestmark = pytest.mark.full


def test_frame_of_the_house(benchmark):
    world = load_world(HOUSE)
    simulator = RaycastSimulator(world)
    pose = simulator.start_pose
    simulator.render(pose)  # compiles
    frame = benchmark(simulator.render, pose)
    assert np.isfinite(frame.depth).any()
