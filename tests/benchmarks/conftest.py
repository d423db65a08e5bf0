"""A real map to measure on: an apartment, seen through the paper's camera with its noise.

Without --benchmark-enable the benchmarks are only tried: on a small map, and each in one size.
"""

import jax.numpy as jnp
import numpy as np
import pytest

import r3jax
from r3jax.mapping.occupancy import mark_free_ball
from r3jax.mapping.update import integrate_growing
from r3jax.scoring.config import ScoringConfig
from r3jax.simulators.scenes import procedural
from r3jax.simulators.scenes.registry import open_scene
from tests.conftest import is_measured

VOXELS, EDGE = 60_000, 512
TRIED_VOXELS, TRIED_EDGE = 6_000, 96


def pytest_collection_modifyitems(config, items):
    """Leaves out the larger sizes (`measured`) where nothing is measured."""
    if not is_measured(config):
        larger = [item for item in items if item.get_closest_marker("measured")]
        items[:] = [item for item in items if item not in larger]
        config.hook.pytest_deselected(items=larger)


class Explored:
    """An apartment of whose map so many voxels are known, or more, after so many views."""

    def __init__(self, voxels, edge, views=1):
        self.simulator = open_scene("apartment", camera=r3jax.Camera.from_fov(edge, edge, 60.0))
        self.camera = self.simulator.camera
        self.map = r3jax.empty_map()
        self.grid = r3jax.empty_grid(self.simulator.bounds)
        self.frames = []
        rooms = list(procedural.rooms("apartment").values())
        rng = np.random.default_rng(0)
        while len(self.frames) < views or int(self.map.num_occupied) < voxels:
            x0, y0, x1, y1 = rooms[len(self.frames) % len(rooms)]
            position = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1), 1.4], dtype=np.float32)
            direction = (rng.standard_normal(3) * [1.0, 1.0, 0.3]).astype(np.float32)
            pose = r3jax.pose_along(jnp.asarray(position), jnp.asarray(direction))
            self.add(self.simulator.render(np.asarray(pose, dtype=np.float64)))

    def add(self, frame: r3jax.Frame) -> None:
        self.map = integrate_growing(self.map, frame)
        grid = r3jax.integrate_depth(self.grid, frame)
        self.grid = mark_free_ball(grid, frame.position, 0.3)
        self.frames.append(frame)

    @property
    def pose(self):
        return self.frames[-1].T_world_camera


@pytest.fixture(scope="session")
def explored(pytestconfig) -> Explored:
    if is_measured(pytestconfig):
        return Explored(VOXELS, EDGE)
    return Explored(TRIED_VOXELS, TRIED_EDGE)


@pytest.fixture(scope="session")
def scoring() -> ScoringConfig:
    return ScoringConfig()
