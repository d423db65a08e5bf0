"""A frame, a decision and a crossing in worlds of any size. Run by `make benchmark`."""

import jax
import numpy as np
import pytest

import r3jax
from experiments.world_size import by_tiles, view
from r3jax.planning.planner import at_hand

pytestmark = pytest.mark.full

SIDES = [12.0, *(pytest.param(side, marks=pytest.mark.measured) for side in (60.0, 240.0))]


@pytest.fixture(scope="module", params=SIDES)
def world(request):
    """A planner by tiles in the middle of a floor of rooms, and what its camera shows there."""
    side, camera = request.param, r3jax.Camera.from_fov(256, 256, 60.0)
    robot = np.array([side // 12 * 6 + 3.3, side // 12 * 6 + 3.1, 1.3])
    return by_tiles(side, robot, camera), view(robot, camera), robot


def test_observe(benchmark, world):
    """Target: 240 m cost at most 1.2 times what 12 m cost."""
    planner, frame, _ = world
    observe = lambda: jax.block_until_ready(r3jax.observe(planner, frame).map_state)
    observe()
    assert benchmark(observe).capacity == planner.map_state.capacity


def test_decide(benchmark, world):
    """Target: 240 m cost at most 1.3 times what 12 m cost."""
    planner, frame, _ = world
    after = r3jax.observe(planner, frame)
    decide = lambda: r3jax.decide(after, frame.T_world_camera, jax.random.key(1))
    decide()
    assert benchmark(decide)[0] is not None


def test_cross(benchmark, world):
    """Target: 50 ms."""
    planner, _, robot = world
    there = robot + np.array([planner.far.tiles.lattice.edge[0] + 1.0, 0.0, 0.0])
    moved = [at_hand(planner, there)]

    def cross():
        moved[0] = at_hand(planner, there)
        jax.block_until_ready(moved[0].map_state)

    # What the block before has left behind is scored in a thread: not beside this one.
    benchmark.pedantic(cross, setup=lambda: moved[0].far.settled and None, rounds=5)
