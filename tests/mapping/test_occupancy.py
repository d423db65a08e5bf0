"""The occupancy grid against exact ray casts of boxes, in float64 NumPy.

Mutants tried by hand, each caught here: a pass that outweighs a hit; the block's farthest instead
of nearest depth; no stop before the hit; depth 0 read as a surface at 0 or as free; `inf` ignored;
passes up to the hit beyond `max_range`; two updates per cell; no clipping; the step of the
cell's own distance at the edge of the range; ball marks that overrule a measured hit.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera, look_at
from r3jax.mapping import occupancy
from r3jax.mapping.occupancy import (
    cell_centers,
    empty_grid,
    frontier,
    frontier_unexplored,
    integrate_depth,
    log_odds_at,
    mark_free_ball,
    world_to_cell,
)
from tests.tiers import quick_and_full

SIZE = 128  # blocks of 2 x 2 pixels
CAMERA = Camera.from_fov(SIZE, SIZE, 60.0)
ROOM = np.array([[0.0, 0.0, 0.0], [6.0, 5.0, 2.6]])
CELL = 0.2
RANGE = 5.0
BLACK = jnp.zeros((SIZE, SIZE, 3))

update = jax.jit(integrate_depth)


def rays_world(T: np.ndarray) -> np.ndarray:
    """Rays through the pixel centers, scaled to z = 1 in the camera, [H, W, 3]."""
    slope = (np.arange(SIZE) + 0.5 - 0.5 * SIZE) / float(CAMERA.fx)
    u, v = np.meshgrid(slope, slope)
    return np.stack([u, v, np.ones_like(u)], axis=-1) @ T[:3, :3].T


def cast(T: np.ndarray, boxes: list[np.ndarray]) -> np.ndarray:
    """Exact z-depth of the room's inside and of solid boxes, [H, W]."""
    rays, start = rays_world(T), T[:3, 3]
    with np.errstate(divide="ignore"):
        near = np.sort(np.stack([(ROOM[0] - start) / rays, (ROOM[1] - start) / rays]), axis=0)
        depth = near[1].min(axis=-1)
        for box in boxes:
            slab = np.sort(np.stack([(box[0] - start) / rays, (box[1] - start) / rays]), axis=0)
            enter, leave = slab[0].max(axis=-1), slab[1].min(axis=-1)
            depth = np.where((enter < leave) & (enter > 0), np.minimum(depth, enter), depth)
    return depth


def frame_at(position, target, depth=None, boxes=()) -> Frame:
    T = look_at(jnp.asarray(position, jnp.float32), jnp.asarray(target, jnp.float32))
    if depth is None:
        depth = cast(np.asarray(T, np.float64), list(boxes))
    return Frame(BLACK, jnp.asarray(np.broadcast_to(depth, (SIZE, SIZE)), jnp.float32), T, CAMERA)


def random_scene(seed: int) -> tuple[Frame, list[np.ndarray]]:
    """A view into the room, with four boxes of which one is a thin pole."""
    rng = np.random.default_rng(seed)
    position = rng.uniform([0.7, 0.7, 0.7], [5.3, 4.3, 1.9])
    boxes = []
    for size in ([0.02, 0.02, 2.5], *rng.uniform(0.1, 1.0, (3, 3))):
        low = rng.uniform(ROOM[0], ROOM[1] - size)
        box = np.stack([low, low + size])
        if np.linalg.norm(np.clip(position, *box) - position) > 0.3:
            boxes.append(box)
    target = position + rng.normal(size=3) * [1, 1, 0.4]
    return frame_at(position, target, boxes=boxes), boxes


def hit_points(frame: Frame) -> np.ndarray:
    """Measured points within range, [n, 3] float64."""
    T, depth = np.asarray(frame.T_world_camera, np.float64), np.asarray(frame.depth, np.float64)
    rays = rays_world(T)
    is_hit = (depth > 0) & (np.linalg.norm(rays, axis=-1) * depth <= RANGE)
    return (T[:3, 3] + rays * np.where(is_hit, depth, 0)[..., None])[is_hit]


def subsamples(grid, count: int = 5) -> np.ndarray:
    """Points spread over every cell, faces included, [X, Y, Z, count**3, 3]."""
    inside = np.linspace(0.0, 1.0, count)
    offset = np.stack(np.meshgrid(inside, inside, inside), -1).reshape(-1, 3)
    index = np.stack(np.meshgrid(*(np.arange(n) for n in grid.log_odds.shape), indexing="ij"), -1)
    origin = np.asarray(grid.origin, np.float64)
    return origin + (index[..., None, :] + offset) * float(grid.cell_size)


def depth_behind(frame: Frame, points: np.ndarray, spread: int) -> tuple[np.ndarray, ...]:
    """z of points; least and greatest depth of the pixels round each; distance from the camera."""
    T = np.asarray(frame.T_world_camera, np.float64)
    local = (points - T[:3, 3]) @ T[:3, :3]
    z = local[..., 2]
    z_safe = np.where(z > 0, z, 1.0)
    pixel = np.stack([local[..., 1], local[..., 0]], -1) / z_safe[..., None] * float(CAMERA.fx)
    pixel = np.floor(pixel + 0.5 * SIZE).astype(int)
    seen = (z > 0) & np.all((pixel >= spread) & (pixel < SIZE - spread), axis=-1)
    depth, low, high = np.asarray(frame.depth, np.float64), np.inf, 0.0
    row, column = (np.where(seen, pixel[..., i], spread) for i in (0, 1))
    for dy in range(-spread, spread + 1):
        for dx in range(-spread, spread + 1):
            near = depth[row + dy, column + dx]
            low, high = np.minimum(low, near), np.maximum(high, near)
    return seen, z, low, high, np.linalg.norm(local, axis=-1)


@pytest.fixture(scope="module")
def grid():
    # Off the room's faces, so that a wall does not fall between two cells.
    return empty_grid(ROOM + np.array([[-0.03], [0.0]]), CELL)


@pytest.mark.parametrize("seed", quick_and_full(range(4), [0]))
def test_hits_are_the_cells_of_the_measured_points(grid, seed):
    frame, _ = random_scene(seed)
    cell = (hit_points(frame) - np.asarray(grid.origin, np.float64)) / CELL
    # Points on a border of cells (the room's walls) may fall to either side by rounding.
    is_clear = np.all(np.abs(cell - np.round(cell)) > 1e-3, axis=1)
    after = np.asarray(update(grid, frame).log_odds)
    index = np.floor(cell[is_clear]).astype(int)
    assert len(index) > 1000
    assert np.all(after[tuple(index.T)] > 1.39)
    raised = np.argwhere(after > 0)
    centers = np.asarray(cell_centers(grid, jnp.asarray(raised, jnp.int32)))
    nearest = np.abs(centers[:, None] - hit_points(frame)[None]).max(-1).min(1)
    assert nearest.max() <= 0.5 * CELL + 1e-4


@pytest.mark.parametrize("seed", quick_and_full(range(4), [0]))
def test_free_space_in_front_of_everything_has_no_gap(grid, seed):
    """A cell that lies wholly in view, in range and well before every surface becomes free."""
    frame, _ = random_scene(seed)
    seen, z, low, _, distance = depth_behind(frame, subsamples(grid, 3), spread=2)
    is_clear = np.all(seen & (z + 0.15 < low) & (distance < RANGE), axis=-1)
    assert is_clear.sum() > 10
    assert np.all(np.asarray(update(grid, frame).free)[is_clear])


@pytest.mark.parametrize("seed", quick_and_full(range(4), [0]))
def test_nothing_is_cleared_that_no_ray_has_passed(grid, seed):
    frame, _ = random_scene(seed)
    seen, z, _, high, _ = depth_behind(frame, subsamples(grid, 7), spread=0)
    any_ray = np.any(seen & (z < high), axis=-1)
    free = np.asarray(update(grid, frame).free)
    assert free.any()
    assert not np.any(free & ~any_ray)


@pytest.mark.parametrize("seed", quick_and_full(range(4), [0]))
def test_no_surface_that_was_measured_is_ever_cleared(grid, seed):
    """Looking at the scene from everywhere, grazing its walls, carves nothing away."""
    _, boxes = random_scene(seed)
    rng = np.random.default_rng(100 + seed)
    after = grid
    for _ in range(12):
        position = rng.uniform(ROOM[0] + 0.3, ROOM[1] - 0.3)
        if any(np.all((position > b[0] - 0.1) & (position < b[1] + 0.1)) for b in boxes):
            continue
        target = position + rng.normal(size=3) * [1, 1, 0.3]
        frame = frame_at(position, target, boxes=boxes)
        before, after = after, update(after, frame)
        cell = world_to_cell(grid, jnp.asarray(hit_points(frame), jnp.float32))
        x, y, z = np.asarray(cell).T
        assert np.all(after.log_odds[x, y, z] >= before.log_odds[x, y, z])


def test_grazing_rays_do_not_erase_a_wall(grid):
    """Twenty looks along the wall y = 0 from 0.4 m: the wall stays, the air before it is free."""
    after = grid
    for x in np.linspace(0.5, 1.5, 20):
        after = update(after, frame_at([x, 0.4, 1.3], [x + 4.0, 0.2, 1.3]))
    wall = jnp.asarray([[x, -1e-3, 1.3] for x in (2.5, 3.0, 3.5, 4.0)], jnp.float32)
    on_wall = jnp.maximum(log_odds_at(after, wall), log_odds_at(after, wall.at[:, 1].set(1e-3)))
    assert bool(jnp.all(on_wall > 4.0))
    air = jnp.asarray([[2.5, 0.5, 1.3], [3.5, 0.5, 1.3]], jnp.float32)
    assert bool(jnp.all(log_odds_at(after, air) < -4.0))


def test_a_thin_pole_survives_looks_from_all_round(grid):
    pole = np.array([[2.99, 2.49, 0.0], [3.01, 2.51, 2.6]])
    after = grid
    for angle in np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False):
        position = np.array([3.0 + 1.8 * np.cos(angle), 2.5 + 1.8 * np.sin(angle), 1.3])
        after = update(after, frame_at(position, [3.0, 2.5, 1.3], boxes=[pole]))
    height = np.arange(0.9, 1.8, 0.05)
    on_pole = jnp.asarray([[3.0, 2.5, z] for z in height], jnp.float32)
    assert not bool(jnp.any(log_odds_at(after, on_pole) <= 0.0))


def test_no_measurement_says_nothing(grid):
    seen = update(grid, frame_at([1.0, 2.5, 1.3], [5.0, 2.5, 1.3]))
    again = update(seen, frame_at([1.0, 2.5, 1.3], [5.0, 2.5, 1.3], depth=0.0))
    np.testing.assert_array_equal(again.log_odds, seen.log_odds)


def test_half_a_picture_without_measurement_leaves_its_half_alone(grid):
    depth = np.where(np.arange(SIZE) < SIZE // 2, 0.0, np.inf)[None, :]
    after = update(grid, frame_at([0.5, 2.5, 1.3], [5.0, 2.5, 1.3], depth=depth))
    right, left = jnp.array([[3.0, 2.0, 1.3]]), jnp.array([[3.0, 3.0, 1.3]])
    assert float(log_odds_at(after, right)[0]) < -1.39
    assert float(log_odds_at(after, left)[0]) == 0.0


def test_the_nearest_measurement_of_a_block_rules_it(grid):
    """A picket fence at 2 m, every other pixel: nothing behind it is cleared."""
    depth = np.where(np.arange(SIZE) % 2 == 0, 2.0, np.inf)[None, :]
    free = update(grid, frame_at([0.5, 2.5, 1.3], [5.0, 2.5, 1.3], depth=depth)).free
    centers = np.asarray(cell_centers(grid, jnp.asarray(np.argwhere(np.asarray(free)))))
    assert len(centers) > 20
    assert centers[:, 0].max() < 2.5


@pytest.mark.parametrize("depth", [np.inf, 5.5, 40.0])
def test_beyond_range_is_free_up_to_the_range_and_hits_nothing(grid, depth):
    position = np.array([0.3, 2.5, 1.3])
    after = update(grid, frame_at(position, [5.0, 2.5, 1.3], depth=depth))
    assert not bool(jnp.any(after.log_odds > 0.0))
    everywhere = subsamples(grid)
    seen, _, _, _, distance = depth_behind(frame_at(position, [5.0, 2.5, 1.3]), everywhere, 0)
    free = np.asarray(after.free)
    assert np.all(free[np.all(seen & (distance < RANGE), axis=-1)])
    assert not np.any(free[np.all(distance > RANGE, axis=-1)])


def test_one_look_decides_anywhere_within_range(grid):
    """At 4.99 m one hit makes a cell occupied, one pass makes it free, and the steps are known."""
    position = [0.40, 2.5, 1.3]
    after = update(grid, frame_at(position, [5.5, 2.5, 1.3], depth=4.98))
    hit = jnp.array([[5.38, 2.5, 1.3]])  # in a cell whose center lies beyond the range
    passed = jnp.array([[2.5, 2.5, 1.3]])
    assert bool(after.occupied[tuple(world_to_cell(grid, hit)[0])])
    np.testing.assert_allclose(log_odds_at(after, hit)[0], 2.8 * 0.5, rtol=1e-5)
    center = cell_centers(grid, world_to_cell(grid, passed))[0]
    d = float(jnp.linalg.norm(center - jnp.array(position)))
    expected = -2.8 * (1.0 - 0.1 * d)
    np.testing.assert_allclose(log_odds_at(after, passed)[0], expected, rtol=1e-5)


def test_log_odds_stay_within_their_limits(grid):
    frame = frame_at([1.0, 2.5, 1.3], [5.0, 2.5, 1.3])
    after = grid
    for _ in range(4):
        after = update(after, frame)
    assert float(after.log_odds.min()) == pytest.approx(-4.5)
    assert float(after.log_odds.max()) == pytest.approx(4.5)


@pytest.mark.full
def test_a_range_may_be_set_and_frames_may_be_mapped_over(grid):
    frames = [frame_at([1.0, 2.5, 1.3], target) for target in ([5.0, 2.5, 1.3], [5.0, 4.0, 1.3])]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *frames)
    together = jax.vmap(integrate_depth, in_axes=(None, 0))(grid, stacked)
    for i, frame in enumerate(frames):
        np.testing.assert_allclose(together.log_odds[i], update(grid, frame).log_odds, atol=1e-5)
    near = update(grid, frames[0], 2.0)
    assert float(log_odds_at(near, jnp.array([[2.5, 2.5, 1.3]]))[0]) < -1.39
    assert float(log_odds_at(near, jnp.array([[3.5, 2.5, 1.3]]))[0]) == 0.0


def test_points_outside_the_grid_are_ignored():
    small = empty_grid(np.array([[2.0, 2.0, 1.0], [3.0, 3.0, 1.6]]), CELL)
    after = update(small, frame_at([1.0, 2.5, 1.3], [5.0, 2.5, 1.3]))
    assert not bool(jnp.any(after.log_odds > 0.0))
    assert bool(jnp.any(after.free))


def test_a_vouched_ball_is_free_but_yields_to_measurements(grid):
    center = jnp.array([1.0, 2.5, 1.3])
    ball = mark_free_ball(grid, center, 0.5)
    index = np.argwhere(np.asarray(ball.free))
    distance = np.linalg.norm(
        np.asarray(cell_centers(grid, jnp.asarray(index))) - np.asarray(center), axis=1
    )
    assert len(index) > 40
    assert distance.max() <= 0.5
    assert int(ball.free.sum()) + int(ball.unexplored.sum()) == ball.log_odds.size
    wall = eqx.tree_at(lambda g: g.log_odds, grid, jnp.full_like(grid.log_odds, 2.0))
    assert not bool(jnp.any(mark_free_ball(wall, center, 0.5).free))
    hit = update(ball, frame_at([0.55, 2.5, 1.3], [5.0, 2.5, 1.3], depth=0.5))
    assert not bool(hit.free[tuple(world_to_cell(grid, jnp.array([1.05, 2.5, 1.3])))])


def test_the_two_sides_of_the_frontier_touch(grid):
    log_odds = np.zeros(grid.log_odds.shape, np.float32)
    log_odds[5:10, 5:10, 5:10] = -3.0
    log_odds[10, 5:10, 5:10] = 3.0
    block = eqx.tree_at(lambda g: g.log_odds, grid, jnp.asarray(log_odds))
    inner, outer = np.asarray(frontier(block)), np.asarray(frontier_unexplored(block))
    expected = np.zeros_like(inner)
    expected[5:10, 5:10, 5:10] = True
    expected[6:10, 6:9, 6:9] = False  # the face x = 9 looks at the wall, not at the unknown
    np.testing.assert_array_equal(inner, expected)
    assert outer.sum() == 5 * 25
    assert not outer[10].any()


def test_cells_and_their_centers_are_inverse(grid):
    cells = jnp.asarray(np.argwhere(np.ones(grid.log_odds.shape))[::37], jnp.int32)
    np.testing.assert_array_equal(world_to_cell(grid, cell_centers(grid, cells)), cells)
    corners = jnp.asarray(ROOM, jnp.float32)
    index = np.asarray(world_to_cell(grid, corners))
    assert np.all((index >= 1) & (index < np.array(grid.log_odds.shape) - 1))
    far = jnp.array([[1e12, 0.0, 0.0], [-1e12, 0.0, 0.0]])
    np.testing.assert_array_equal(log_odds_at(grid, far, outside=7.0), [7.0, 7.0])


@pytest.mark.parametrize(
    ("bounds", "cell_size", "message"),
    [
        ([[0, 0, 0], [1, 1, 0]], 0.2, "corner"),
        ([[0, 0, 0], [1, 1, np.nan]], 0.2, "corner"),
        ([0, 0, 0], 0.2, "corner"),
        ([[0, 0, 0], [1, 1, 1]], 0.0, "cell_size"),
        ([[0, 0, 0], [9000, 9000, 3000]], 0.2, "in meters"),
    ],
)
def test_bad_bounds_are_named(bounds, cell_size, message):
    with pytest.raises(ValueError, match=message):
        empty_grid(np.array(bounds, float), cell_size)


formulas = jax.jit(occupancy._by_formulas)
kernel = jax.jit(occupancy._by_kernel)

LENSES = (Camera(24, 40, 30.0, 34.0, 11.0, 20.5), Camera(130, 70, 60.0, 60.0, 65.0, 35.0))
"""Narrow and upright with blocks of one pixel; wide with blocks of two that do not divide it."""


@given(
    seed=st.integers(0, 10**6),
    lens=st.sampled_from(LENSES),
    reach=st.sampled_from([0.3, 2.0, 5.0, np.inf]),
    noise=st.sampled_from([0.0, 0.3]),
    is_inside=st.booleans(),
)
@settings(max_examples=30)
def test_the_kernel_updates_the_cells_that_the_formulas_update(seed, lens, reach, noise, is_inside):
    """In front of a tilted wall with a step; other cameras see the grid from outside, or not."""
    random = np.random.default_rng(seed)
    eye, aim = random.normal(size=3), random.normal(size=3)
    low = eye - random.uniform([1.0, 1.0, 0.7], [3.0, 2.0, 1.3]) - (0.0 if is_inside else 2.0)
    grid = empty_grid(low + np.array([[0.0, 0.0, 0.0], [4.0, 3.0, 2.0]]), CELL)
    before = random.uniform(-4.5, 4.5, grid.log_odds.shape).astype(np.float32)
    grid = eqx.tree_at(lambda g: g.log_odds, grid, jnp.asarray(before))
    depth = random.uniform(0.5, 3.0) + np.linspace(0.0, 0.8, lens.height)[:, None]
    depth = depth + noise * random.random((lens.height, lens.width))
    depth[:, lens.width // 2 :] += random.uniform(0.0, 2.0)
    depth[random.random(depth.shape) < noise] = 0.0
    depth[random.random(depth.shape) < 0.3 * noise] = np.inf
    T = look_at(jnp.asarray(eye, jnp.float32), jnp.asarray(eye + aim, jnp.float32))
    frame = Frame(jnp.zeros((*depth.shape, 3)), jnp.asarray(depth, jnp.float32), T, lens)
    found, expected = (f(grid, frame, jnp.float32(reach)) for f in (kernel, formulas))
    # Rounding may put a point or an octant on the other side of a cell's or a pixel's edge.
    changed = np.abs(np.asarray(expected) - before) > 1e-5
    assert not is_inside or reach < 1.0 or changed.sum() > 5
    differ = ~np.isclose(found, expected, atol=1e-5)
    assert differ.sum() <= 2 + 0.001 * changed.sum()


def test_a_pose_that_is_not_rigid_changes_no_cell(grid):
    frame = frame_at([1.0, 2.5, 1.3], [5.0, 2.5, 1.3])
    # A frame refuses such a pose, but not what happens to it under jit.
    skewed = eqx.tree_at(lambda f: f.T_world_camera, frame, 2.0 * frame.T_world_camera)
    after = update(grid, skewed)
    np.testing.assert_array_equal(after.log_odds, grid.log_odds)
    assert np.isnan(float(after.cell_size))
