"""A view, pixel by pixel, against float64 rays through the cubes of a small map.

The map holds things out of everyone's range, so that gathering drops and reorders rows.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import r3jax
from r3jax.baselines import pixels
from r3jax.geometry.cameras import Camera, pose_along
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.utility import view_utility

VOXEL = 0.1
CAPACITY = 1 << 13
CAMERA = Camera.from_fov(96, 72, 70.0)
WIDTH, HEIGHT = 48, 36  # of the depth buffer
CONFIG = ScoringConfig(max_range=6.0, zbuffer_size=48)
LOOKS = {
    "square on": ((-2.0, 0.0, 1.2), (1.0, 0.0, 0.0)),
    "aslant": ((-1.6, -2.3, 0.7), (0.8, 0.4, 0.1)),
    "up, from near by": ((1.1, 0.2, 0.3), (0.5, -0.2, 0.9)),
    "into the open": ((0.0, 0.0, 1.2), (-1.0, 0.0, 0.0)),
}
POSES = np.stack(
    [np.asarray(pose_along(jnp.asarray(p), jnp.asarray(d))) for p, d in LOOKS.values()]
)
PIXEL_ANGLE = np.tan(np.deg2rad(35.0)) / (WIDTH / 2)  # on the axis [rad]
STEP = 1e-4  # the buffer's distances are cut into steps [m]
FINE_FROM = 3.3  # from here on a voxel covers two pixels at most [m]
GRID_ORIGIN, CELL, GRID_SHAPE = np.array([-7.0, -5.0, -2.0]), 0.5, (20, 15, 9)
# Its last cell, with which cells are padded, is in view of the first pose.


@functools.cache
def small_map():
    """A wall, some boxes before and behind it, and much more that nobody can see; the cells.

    Returns:
        The map, and the integer voxels that it holds in order of the map's rows, [N, 3]; those
        of empty rows are far away.
    """
    random = np.random.default_rng(4)
    wall = np.array([(25, y, z) for y in range(-14, 8) for z in range(0, 24)])
    boxes = random.integers((8, -16, 2), (38, 16, 24), (60, 3))
    far = random.integers((300, 300, 0), (330, 330, 20), (600, 3))
    beyond = np.array([(45, y, z) for y in range(-20, 20) for z in range(0, 30)])
    index = np.unique(np.concatenate([far, wall, boxes, beyond]), axis=0)
    points = random.permutation(((index + 0.5) * VOXEL).astype(np.float32))
    state = r3jax.integrate_points(
        r3jax.empty_map(CAPACITY, VOXEL),
        points,
        np.full_like(points, 0.5),
        np.array([0.0, 0.0, 1.2], np.float32),
    )
    rows = np.asarray(r3jax.lookup(state, jnp.asarray(points)))
    assert len(np.unique(rows)) == len(index)
    table = np.full((CAPACITY, 3), 10**6)
    table[rows] = np.floor(points.astype(np.float64) / VOXEL).astype(int)
    return state, table


def grid_where(unexplored: np.ndarray) -> OccupancyGrid:
    return OccupancyGrid(
        log_odds=jnp.asarray(np.where(unexplored, 0.0, -3.0), jnp.float32),
        origin=jnp.asarray(GRID_ORIGIN, jnp.float32),
        cell_size=jnp.asarray(CELL, jnp.float32),
    )


def some_grid() -> OccupancyGrid:
    return grid_where(np.random.default_rng(1).random(GRID_SHAPE) < 0.4)


def everything(view):
    """The whole view as the value of a pose."""
    return view


def look(module, state, grid, reach=None):
    """Views with two things about each row: its number, and its voxel index."""
    _, table = small_map()
    rows = {"row": np.arange(CAPACITY, dtype=np.int32), "index": table.T.astype(np.int32)}
    return module.score_pixels(everything, state, grid, CAMERA, POSES, CONFIG, rows, reach)


def rays(pose: np.ndarray) -> np.ndarray:
    """Unit vectors through the pixel centers of the buffer, [h, w, 3] float64."""
    focal = 0.5 * WIDTH / np.tan(np.deg2rad(35.0))
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    inside = np.stack([x - WIDTH / 2, y - HEIGHT / 2, np.full_like(x, focal)], axis=-1)
    world = inside @ pose[:3, :3].astype(np.float64).T
    return world / np.linalg.norm(world, axis=-1, keepdims=True)


def nearest_center(
    centers: np.ndarray, pose: np.ndarray, scale: float, pixels: float, least_depth: float = 0.0
) -> np.ndarray:
    """Of the cubes that rays hit, the least distance of a center [m]: [h, w]; inf: none is hit.

    Cubes are within range and `least_depth` or more ahead; their edges are multiplied by `scale`
    and moved outward by `pixels`.
    """
    position, ray = pose[:3, 3].astype(np.float64), rays(pose)
    nearest = np.full(ray.shape[:2], np.inf)
    for center in centers:
        offset = center - position
        distance = np.linalg.norm(offset)
        if distance > float(CONFIG.max_range) or offset @ pose[:3, 2] < least_depth:
            continue
        half = 0.5 * scale * VOXEL + pixels * distance * PIXEL_ANGLE
        t = np.sort((offset + np.array([[-half], [half]]))[:, None, None, :] / ray, axis=0)
        is_hit = (t[0].max(axis=-1) < t[1].min(axis=-1)) & (t[1].min(axis=-1) > 0.0)
        nearest = np.where(is_hit, np.minimum(nearest, distance), nearest)
    return nearest


@functools.cache
def traced_rays() -> list[tuple[np.ndarray, np.ndarray]]:
    """Per pose what a pixel may show at the farthest and at the nearest [m]."""
    _, table = small_map()
    centers = (table[table[:, 0] < 200] + 0.5) * VOXEL
    # Near voxels are drawn into coarser levels, whose pixels they do not fill to the edge.
    far = [nearest_center(centers, pose, 0.98, 0.0, FINE_FROM) for pose in POSES]
    near = [nearest_center(centers, pose, 1.4, 0.75) for pose in POSES]
    return list(zip(far, near, strict=True))


def test_rows() -> None:
    """A pixel carries the row of its voxel, and the voxel's place."""
    state, table = small_map()
    views = look(pixels, state, some_grid())
    for i, pose in enumerate(POSES):
        hit, row = np.asarray(views.hit[i]), np.asarray(views.rows["row"][i])
        assert hit.any() == (i < 3)
        carried = np.moveaxis(np.asarray(views.rows["index"][i]), 0, -1)
        np.testing.assert_array_equal(carried[hit], table[row][hit])
        from_camera = (table[row] + 0.5) * VOXEL - pose[:3, 3].astype(np.float64)
        offset = np.moveaxis(np.asarray(views.offset[i]), 0, -1)
        np.testing.assert_allclose(offset[hit], -from_camera[hit], atol=1e-5)
        depth = np.where(hit, from_camera @ pose[:3, 2].astype(np.float64), np.inf)
        np.testing.assert_allclose(views.depth[i], depth, atol=1e-5)
        assert not hit.any() or depth[hit].min() > 0.0


def test_rays() -> None:
    """What a pixel shows lies between what its ray must hit and what it may touch."""
    state, _ = small_map()
    views = look(pixels, state, some_grid())
    for i, (farthest, nearest) in enumerate(traced_rays()):
        offset = np.linalg.norm(np.asarray(views.offset[i]), axis=0)
        distance = np.where(views.hit[i], offset, np.inf)
        assert np.all(distance <= farthest + STEP)
        is_fine = np.asarray(views.depth[i]) >= FINE_FROM
        assert np.all(distance[is_fine] >= nearest[is_fine] - STEP)
        assert i >= 2 or (np.isfinite(farthest) & is_fine).sum() > 100


def test_cells_as_in_utility() -> None:
    """The unexplored cells in view are those of U_G, exactly."""
    state, grid = small_map()[0], some_grid()
    views = look(pixels, state, grid)
    expected = [float(view_utility(state, grid, CAMERA, p, CONFIG).exploration) for p in POSES]
    assert min(expected) > 5.0
    np.testing.assert_array_equal(views.cells, np.float32(expected))


def test_single_cells() -> None:
    """One unexplored cell counts, but not if it is hidden, out of range or of view."""
    state, _ = small_map()
    cases = {
        (0, 0.25, 0.25, 1.25): True,  # before the wall
        (0, 2.75, -0.25, 1.25): False,  # behind it
        (0, 2.75, 2.25, 1.25): True,  # beside it
        (0, -3.25, 0.25, 1.25): False,  # behind the camera
        (0, -1.25, 2.25, 1.25): False,  # beside the picture
        (3, -4.75, -1.25, 1.25): True,
        (3, -6.75, -1.25, 1.25): False,  # out of range
    }
    for (pose, *where), is_seen in cases.items():
        center = np.array(where)
        unexplored = np.zeros(GRID_SHAPE, bool)
        unexplored[tuple(np.floor((center - GRID_ORIGIN) / CELL).astype(int))] = True
        views = look(pixels, state, grid_where(unexplored))
        assert float(views.cells[pose]) == is_seen, where


def test_reach() -> None:
    """Voxels beyond the range show where nothing was before; cells beyond it never do."""
    state, grid = small_map()[0], some_grid()
    near, far = (look(pixels, state, grid, reach) for reach in (None, 8.0))
    was_hit, is_hit = np.asarray(near.hit), np.asarray(far.hit)
    assert np.all(is_hit[was_hit])
    np.testing.assert_allclose(far.depth[was_hit], near.depth[was_hit], atol=1e-5)
    distance = np.linalg.norm(np.asarray(far.offset), axis=1)[is_hit & ~was_hit]
    assert len(distance) > 20
    assert distance.min() > float(CONFIG.max_range) - STEP
    assert distance.max() <= 8.0 + STEP
    np.testing.assert_array_equal(far.cells, near.cells)


def test_a_value_is_compiled_once_for_all_poses_and_maps_of_a_size():
    traces = []

    def mean_depth(view):
        traces.append(view)
        return jnp.sum(jnp.where(view.hit, view.depth, 0.0))

    state, _ = small_map()
    grid = some_grid()
    score = functools.partial(pixels.score_pixels, mean_depth)
    first = score(state, grid, CAMERA, POSES, CONFIG)
    compilations = len(traces)  # two cores may both trace the first time
    moved = POSES.copy()
    moved[:, 0, 3] += 0.05
    second = score(state, grid, CAMERA, moved, CONFIG)
    score(
        r3jax.empty_map(CAPACITY, VOXEL),
        grid,
        CAMERA,
        POSES,
        ScoringConfig(max_range=2.0, zbuffer_size=48),
    )
    assert 1 <= compilations == len(traces)
    assert first.shape == (len(POSES),)
    assert np.any(np.asarray(first) != np.asarray(second))


def test_sizes_cannot_be_chosen_under_jit():
    state, _ = small_map()
    score = lambda p: pixels.score_pixels(everything, state, some_grid(), CAMERA, p, CONFIG)
    with pytest.raises(TypeError, match="outside jit"):
        jax.jit(score)(jnp.asarray(POSES))
