"""How long the planner's own parts take. Off by default: `pytest --benchmark-enable`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera, look_at
from r3jax.mapping.occupancy import OccupancyGrid, empty_grid, integrate_depth
from r3jax.planning.candidates import draw_positions
from r3jax.planning.config import PlannerConfig
from r3jax.planning.robot.explorable import mask_unexplorable
from r3jax.planning.robot.travel import plan_travel

pytestmark = pytest.mark.full

HOUSE = np.array([[0.0, 0.0, 0.0], [12.0, 12.0, 5.0]])  # 62 x 62 x 27 = 104k cells


def furnished(grid: OccupancyGrid) -> OccupancyGrid:
    """The box as free space with thirty pieces of furniture in it."""
    rng = np.random.default_rng(0)
    log_odds = np.full(grid.log_odds.shape, -3.0, np.float32)
    for _ in range(30):
        low = rng.integers(2, [54, 54, 12])
        high = low + rng.integers(2, 8, 3)
        log_odds[low[0] : high[0], low[1] : high[1], : high[2]] = 3.0
    log_odds[:, :, 20:] = 0.0
    return OccupancyGrid(jnp.asarray(log_odds), grid.origin, grid.cell_size)


@pytest.fixture(scope="module")
def house() -> OccupancyGrid:
    return furnished(empty_grid(HOUSE))


@pytest.fixture(scope="module")
def position(house) -> np.ndarray:
    """A place with room around it."""
    everything = plan_travel(house, np.full(3, -10.0))
    cells = np.argwhere(everything.safe)
    return everything.centers(cells[len(cells) // 2])


def test_integrate_depth(benchmark):
    """Target: 4 ms for a 512x512 frame."""
    grid = empty_grid(HOUSE)
    depth = np.random.default_rng(0).uniform(3.0, 4.8, (512, 512)).astype(np.float32)
    T = look_at(jnp.array([6.0, 1.0, 1.2]), jnp.array([6.0, 6.0, 1.0]))
    frame = Frame(jnp.zeros((512, 512, 3)), jnp.asarray(depth), T, Camera.from_fov(512, 512))
    update = jax.jit(integrate_depth)
    after = benchmark(lambda: jax.block_until_ready(update(grid, frame)))
    assert int(after.free.sum()) > 500


def test_travel(benchmark, house, position):
    """Target: 30 ms for 100k cells, half of them safe."""
    travel = benchmark(plan_travel, house, position)
    assert travel.reachable.sum() > 20000


def test_everything_but_scoring(benchmark, house, position):
    """Travel, the mask for scoring, 100 candidates, their path lengths. Target: 60 ms."""
    config = PlannerConfig()
    key = jax.random.key(0)

    def plan():
        travel = plan_travel(house, position)
        scoring_grid = mask_unexplorable(house, travel.reachable)
        positions, _ = draw_positions(travel, scoring_grid, config, key=key)
        return travel.lengths(positions)

    lengths = benchmark(plan)
    assert np.all(np.isfinite(lengths))
    assert len(lengths) == config.num_candidates
