"""Keep-out zones, costmaps, LiDAR, refused goals, and robots that cannot leave their place."""

import itertools

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

import r3jax
from r3jax.geometry.cameras import look_at
from r3jax.mapping.occupancy import empty_grid, integrate_rays
from r3jax.planning.columns import Plane, polygon_columns
from r3jax.planning.robot.motion import make_motion

BOUNDS = np.array([[0.0, 0.0, 0.0], [4.0, 3.0, 2.0]])
CAMERA = r3jax.Camera.from_fov(64, 48, 70.0)


def pose_at(x, y, z=1.0):
    return np.asarray(look_at(np.array([x, y, z]), np.array([x + 1.0, y, z])), float)


def planner_in(free_from=0.0, free_to=4.0, **settings):
    """A planner whose grid is free between two x."""
    few = {"num_candidates": 12, "num_frontier": 4}
    planner = r3jax.start(CAMERA, BOUNDS, r3jax.make_policy("random", **few, **settings),
                          config=r3jax.MappingConfig(capacity=1 << 10))  # fmt: skip
    x = np.asarray(planner.grid.origin)[0] + 0.2 * (np.arange(planner.grid.log_odds.shape[0]) + 0.5)
    log_odds = np.array(planner.grid.log_odds)
    log_odds[(x > free_from) & (x < free_to)] = -3.0
    grid = jax.tree.map(lambda a: a, planner.grid)
    object.__setattr__(grid, "log_odds", jax.numpy.asarray(log_odds))
    object.__setattr__(planner, "grid", grid)
    return planner


def goals_of(planner, pose, num=12):
    for key in jax.random.split(jax.random.key(1), num):
        decision, planner, info = r3jax.decide(planner, pose, key)
        assert decision is not None, info
        yield decision


def inside(points, low, high):
    return np.all((points[:, :2] > low) & (points[:, :2] < high), axis=1)


def test_no_path_enters_a_zone_until_it_is_opened():
    low, high = np.array([1.4, -0.5]), np.array([1.8, 2.2])
    zone = [[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]]
    planner = r3jax.keep_out(planner_in(), [zone])
    pose = pose_at(1.0, 1.5)
    for decision in goals_of(planner, pose):
        ways = [a + t * (b - a) for a, b in itertools.pairwise(decision.waypoints)
                for t in np.linspace(0, 1, 30)]  # fmt: skip
        assert not inside(np.array(ways), low, high).any()
    assert r3jax.keep_out(planner, []).grid.closed.sum() == 0


@given(
    corners=st.lists(st.tuples(st.floats(0.0, 4.0), st.floats(0.0, 3.0)), min_size=3, max_size=6)
)
@settings(max_examples=50, deadline=None)
def test_a_polygon_closes_the_columns_that_it_holds_points_of(corners):
    grid, polygon = empty_grid(BOUNDS), np.array(corners)
    shape = grid.log_odds.shape[:2]
    plane = Plane(np.asarray(grid.origin, np.float64)[:2], 0.2, np.array([(0, 0), shape], float))
    columns = np.zeros(shape, bool)
    columns[tuple(polygon_columns(plane, polygon).T)] = True
    cells = np.argwhere(np.ones(columns.shape, bool))
    found = np.zeros(columns.shape, bool)
    for dx in (0.125, 0.375, 0.625, 0.875):
        for dy in (0.125, 0.375, 0.625, 0.875):
            points = np.asarray(grid.origin, np.float64)[:2] + 0.2 * (cells + np.array([dx, dy]))
            # Even-odd, as ours: crossing edges of a star leave its middle out.
            hits = _even_odd(polygon, points)
            found[tuple(cells.T)] |= hits
    np.testing.assert_array_equal(columns, found)


def _even_odd(polygon, points):
    """Winding by crossings, point by point."""
    inside = np.zeros(len(points), bool)
    for k, (x, y) in enumerate(points):
        j = len(polygon) - 1
        for i in range(len(polygon)):
            (xi, yi), (xj, yj) = polygon[i], polygon[j]
            if (yi > y) != (yj > y) and x < (xj - xi) * (y - yi) / (yj - yi) + xi:
                inside[k] = not inside[k]
            j = i
    return inside


def test_a_costmap_lies_as_ros_has_it():
    """Row by row along y, the first pixel at the origin; only lethal pixels close."""
    data = np.zeros((30, 40), np.int8)  # height, width: 0.1 m pixels over the box
    data[5, 31] = 100
    data[20, 3] = 99
    data[25, 35] = -1
    planner = r3jax.with_costmap(planner_in(), data, 0.1, [0.0, 0.0, 0.0])
    cells = np.argwhere(planner.grid.closed.any(axis=2))
    centers = np.asarray(planner.grid.origin)[:2] + 0.2 * (cells + 0.5)
    np.testing.assert_allclose(centers, [[3.1, 0.5]], atol=0.01)
    data[:] = 0
    again = r3jax.with_costmap(planner, data, 0.1, [0.0, 0.0])
    assert not again.grid.closed.any()
    with pytest.raises(ValueError, match="height"):
        r3jax.with_costmap(planner, data.ravel(), 0.1, [0.0, 0.0])


@given(
    resolution=st.floats(0.03, 1.2),
    origin=st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)),
    seed=st.integers(0, 99),
)
@settings(max_examples=40, deadline=None)
def test_every_column_under_a_pixel_is_closed_and_one_under_free_pixels_alone_trusted(
    resolution, origin, seed
):
    """Whatever the edge of a pixel, larger than a cell, too."""
    data = np.random.default_rng(seed).choice([-1, 0, 50, 100], size=(9, 11)).astype(np.int8)
    grid = r3jax.with_costmap(planner_in(), data, resolution, origin, trust_free=True).grid
    closed, trusted = grid.closed.any(axis=2), grid.trusted.any(axis=2)

    def under(pixels: np.ndarray) -> np.ndarray:
        """Columns that some of 40 x 40 points inside of each pixel lie in."""
        rows, columns = np.nonzero(pixels)
        inside = np.linspace(0.02, 0.98, 40)
        x, y = np.meshgrid(inside, inside)
        points = np.stack([columns[:, None] + x.ravel(), rows[:, None] + y.ravel()], axis=-1)
        places = np.array(origin) + resolution * points - np.asarray(grid.origin)[:2]
        cells = np.floor(places.reshape(-1, 2) / 0.2).astype(int)
        found = np.zeros(closed.shape, bool)
        found[tuple(cells[np.all((cells >= 0) & (cells < closed.shape), axis=1)].T)] = True
        return found

    assert closed[under(data == 100)].all()
    assert not trusted[under((data == 100) | (data == -1))].any()
    is_free = (data == 0) | (data == 50)
    assert under(is_free)[trusted].all()
    assert trusted[under(is_free) & ~ndimage.binary_dilation(under(~is_free))].all()
    untrusted = r3jax.with_costmap(planner_in(), data, resolution, origin)
    assert not untrusted.grid.trusted.any()


def test_zones_and_costmap_do_not_undo_each_other():
    planner = r3jax.keep_out(planner_in(), [[[0, 0], [1, 0], [1, 1], [0, 1]]])
    closed = planner.grid.closed.copy()
    data = np.zeros((30, 40), np.int8)
    data[20, 30] = 100
    both = r3jax.with_costmap(planner, data, 0.1, [0.0, 0.0]).grid.closed
    assert both.sum() > closed.sum()
    assert both[closed].all()


def test_a_refused_goal_is_left_alone():
    planner, pose = planner_in(), pose_at(2.0, 1.5)
    first = next(goals_of(planner, pose))
    refused = r3jax.refuse(planner, first, radius=0.3)
    goal = first.T_world_camera[:3, 3]
    for decision in goals_of(refused, pose):
        # A goal lies up to a quarter of a cell off the middle of its cell.
        assert np.linalg.norm(decision.T_world_camera[:3, 3] - goal) > 0.3 - 0.1


def test_lidar_frees_what_rays_pass_and_closes_where_they_end():
    planner = r3jax.start(CAMERA, BOUNDS, "random")
    angle = np.linspace(0, 2 * np.pi, 720, endpoint=False) + 1e-3
    sensor = np.array([2.0, 1.5, 0.5])
    direction = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    # A box room: the nearest wall along each ray.
    with np.errstate(divide="ignore"):
        reach = np.min(np.where(direction[:, :2] > 0, (BOUNDS[1, :2] - 0.05 - sensor[:2]),
                                (0.05 - sensor[:2])) / direction[:, :2], axis=1)  # fmt: skip
    points = sensor + reach[:, None] * direction
    points = np.concatenate([points, [[np.nan] * 3]])
    for _ in range(2):
        planner = r3jax.observe_points(planner, points, sensor)
    grid = planner.grid
    layer = int((0.5 - float(grid.origin[2])) / 0.2)
    free, occupied = np.asarray(grid.free)[:, :, layer], np.asarray(grid.occupied)[:, :, layer]
    assert free[3:-3, 3:-3].mean() > 0.97
    assert occupied[1, 2:-2].all()
    assert occupied[-2, 2:-2].all()
    assert not np.asarray(grid.occupied)[:, :, [0, layer - 2, layer + 2]].any()


@given(seed=st.integers(0, 1000))
@settings(max_examples=25, deadline=None)
def test_a_ray_passes_the_cells_that_sampling_finds_on_it(seed):
    rng = np.random.default_rng(seed)
    grid = empty_grid(BOUNDS)
    a, b = rng.uniform([0, 0, 0], [4, 3, 2], (2, 3))
    after = integrate_rays(grid, b[None], a[None], 10.0)
    t = np.linspace(0.0, 1.0, 20_000)
    cells = np.floor((a + t[:, None] * (b - a) - np.asarray(grid.origin, np.float64)) / 0.2).astype(
        int
    )
    end = tuple(cells[-1])
    length = np.linalg.norm(b - a) / 0.2
    cells, counts = np.unique(cells[t * length < length - 0.25], axis=0, return_counts=True)
    chord = counts / len(t) * length
    log_odds = np.asarray(after.log_odds)
    assert log_odds[end] > 0.0
    for cell, c in zip(cells, chord, strict=True):
        if tuple(cell) != end and abs(c - 0.5) > 0.01:
            assert (log_odds[tuple(cell)] < 0.0) == (c > 0.5)
    assert np.count_nonzero(log_odds) <= len(cells) + 1


def test_a_robot_that_cannot_leave_says_why():
    """The ball of known free cells reaches into the floor of a robot with a low camera."""
    planner = r3jax.start(CAMERA, BOUNDS,
                          r3jax.make_policy("random", num_candidates=8, num_frontier=2,
                                            motion=make_motion("ground", body=0.2)),
                          starts=[pose_at(2.0, 1.5, 0.3)])  # fmt: skip
    pose, info = pose_at(2.0, 1.5, 0.3), None
    for key in jax.random.split(jax.random.key(0), 8):
        decision, planner, info = r3jax.decide(planner, pose, key)
        if decision is None:
            break
        pose = decision.T_world_camera
    assert info.outcome is r3jax.DecisionOutcome.SHUT_IN
    assert "Body" in info.reason
    assert info.limited_by["not_free"] > 0
    assert info.limited_by["below"] > 0


def test_a_camera_outside_of_the_bounds_is_told():
    planner = r3jax.start(CAMERA, BOUNDS, "random")
    decision, _, info = r3jax.decide(planner, pose_at(9.0, 9.0), jax.random.key(0))
    assert decision is None
    assert "bounds" in info.reason
