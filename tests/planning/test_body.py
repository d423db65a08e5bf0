"""Laws of what a body with a footprint needs: room on the floor, and nothing in its way."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import TRUSTED, OccupancyGrid
from r3jax.planning.decide import driven_pixels
from r3jax.planning.robot.body import Body
from r3jax.planning.robot.motion import make_motion, motion_of_record
from r3jax.planning.robot.room import Been, Room, room_for
from r3jax.planning.robot.travel import plan_travel
from r3jax.runs.header import plain_settings

CELL, VOXEL, SIZE = 0.2, 0.05, 4.0
HEIGHT = 0.5
SHAPE = (22, 22, 8)


def grid_of(free: np.ndarray) -> OccupancyGrid:
    log_odds = np.where(free, -3.0, 0.0).astype(np.float32)
    origin = jnp.asarray([-CELL, -CELL, -CELL], jnp.float32)
    return OccupancyGrid(jnp.asarray(log_odds), origin, jnp.asarray(CELL, jnp.float32))


def all_free() -> np.ndarray:
    free = np.zeros(SHAPE, bool)
    free[1:-1, 1:-1, 1:] = True
    return free


def floor_voxels(height=lambda x, y: 0.0 * x) -> np.ndarray:
    x, y = np.meshgrid(*[np.arange(0.025, SIZE, VOXEL)] * 2, indexing="ij")
    z = (np.floor(height(x, y) / VOXEL + 1e-9) + 0.5) * VOXEL - VOXEL
    return np.stack([x, y, z], axis=-1).reshape(-1, 3)


def pole(x: float, y: float, low: float = 0.0, high: float = 1.0) -> np.ndarray:
    z = np.arange(low + 0.5 * VOXEL, high, VOXEL)
    return np.column_stack([np.full(len(z), x), np.full(len(z), y), z])


def pose_at(x: float, y: float, z: float = HEIGHT) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]  # level, along x
    pose[:3, 3] = x, y, z
    return pose


def room_of(body: Body, voxels: np.ndarray, free: np.ndarray | None = None, at=(2.0, 2.0)) -> Room:
    grid = grid_of(all_free() if free is None else free)
    return room_for(body, grid, voxels, VOXEL, pose_at(*at))


poles = st.lists(
    st.tuples(st.integers(2, 77), st.integers(2, 77)).map(lambda p: (p[0] + 0.5, p[1] + 0.5)),
    min_size=1,
    max_size=12,
)


@given(poles=poles, radius=st.floats(0.1, 0.4), goal=st.tuples(*[st.floats(0.2, 3.8)] * 2))
@settings(max_examples=40, deadline=None)
def test_no_point_of_a_footprint_comes_into_an_obstacle(poles, radius, goal):
    """Of a path, wherever it leads; the oracle is a search tree over the obstacles' corners."""
    places = np.array(poles) * VOXEL
    places = places[np.linalg.norm(places - 2.0, axis=1) > radius + 0.15]
    voxels = np.concatenate([floor_voxels(), *[pole(x, y) for x, y in places]])
    room = room_of(Body(radius), voxels)
    height = (HEIGHT, HEIGHT)
    travel = plan_travel(grid_of(all_free()), pose_at(2, 2)[:3, 3], heights=height, room=room)
    end = np.array([*goal, HEIGHT])
    (length,) = travel.lengths(end[None])
    if not np.isfinite(length) or not len(places):
        return
    path = travel.path(end)
    np.testing.assert_array_equal(path[[0, -1], :2], [[2.0, 2.0], end[:2]])
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).sum() <= length + 1e-6
    t = np.linspace(0.0, 1.0, 60)[:, None]
    points = np.concatenate([a + t * (b - a) for a, b in itertools.pairwise(path)])
    offsets = np.array([(i, j) for i in (-0.5, 0.5) for j in (-0.5, 0.5)]) * VOXEL
    corners = (places[:, None] + offsets).reshape(-1, 2)
    assert cKDTree(corners).query(points[:, :2])[0].min() >= radius


@given(radius=st.floats(0.1, 0.35), gap=st.floats(0.3, 1.2))
@settings(max_examples=30, deadline=None)
def test_a_door_is_passed_if_it_is_wide_enough(radius, gap):
    """With the margin, and at most two voxels of the map to spare."""
    y = np.arange(0.025, SIZE, VOXEL)
    wall = [pole(3.025, v) for v in y if abs(v - 2.0) > 0.5 * gap]
    room = room_of(Body(radius), np.concatenate([floor_voxels(), *wall]))
    is_beyond = np.isfinite(room.cost[18:21]).any()
    needed = 2.0 * (radius + 0.05)
    if gap > needed + 0.2:
        assert is_beyond
    if gap < 2.0 * radius:
        assert not is_beyond


def test_ramps_and_a_noisy_floor_are_no_obstacles_but_steps_are():
    ramp = floor_voxels(lambda x, y: np.maximum(0.0, x - 2.5) * np.tan(np.radians(12.0)))
    noisy = floor_voxels()
    noisy[:, 2] += VOXEL * np.random.default_rng(0).integers(0, 2, len(noisy))
    step = floor_voxels(lambda x, y: np.where(x > 3.0, 0.3, 0.0))
    free = all_free()
    for name, voxels, is_open in (
        ("ramp", ramp, True),
        ("noisy", noisy, True),
        ("step", step, False),
    ):
        room = room_of(Body(0.2), voxels, free)
        assert np.isfinite(room.cost[18, 6:15]).any() == is_open, name


def test_what_is_above_the_body_or_no_higher_than_a_step_is_passed():
    y = np.arange(0.025, SIZE, VOXEL)
    for low, high, is_open in (
        (0.0, 0.1, True),
        (0.6, 1.0, True),
        (0.0, 0.2, False),
        (0.4, 0.6, False),
    ):
        bar = [pole(3.025, v, low, high) for v in y]
        room = room_of(Body(0.2), np.concatenate([floor_voxels(), *bar]))
        assert np.isfinite(room.cost[18:21]).any() == is_open, (low, high)


def test_unknown_cells_below_the_camera_count_as_the_policy_says():
    free = all_free()
    free[:, :, :2] = False  # nothing is known of the lowest layer, but for the floor's voxels
    seen = floor_voxels()
    near_and_far = seen[(seen[:, 0] > 2.8) | (seen[:, 0] < 1.0)]
    camera_less = lambda policy, voxels: room_of(Body(0.2, unknown_below=policy), voxels, free)
    assert np.isfinite(camera_less("free", seen).cost[18]).any()
    assert not np.isfinite(camera_less("never", near_and_far).cost[18]).any()
    assert not np.isfinite(camera_less("free", near_and_far).cost[18]).any()


@given(width=st.floats(0.16, 0.3), end=st.floats(1.0, 3.0), radius=st.floats(0.1, 0.3))
@settings(max_examples=30, deadline=None)
def test_the_hidden_part_of_a_wall_is_not_driven_through(width, end, radius):
    """Of a wall with one side in view the map has that side; its cells are occupied or unknown."""
    face = 2.6
    is_hidden = lambda p: (p[:, 0] > face) & (p[:, 0] < face + width) & (p[:, 1] < end)
    seen = floor_voxels()
    seen = seen[~is_hidden(seen)]
    y = np.arange(0.025, end, VOXEL)
    voxels = np.concatenate([seen, *[pole(face + 0.025, v) for v in y]])
    centers = -CELL + CELL * (np.moveaxis(np.indices(SHAPE), 0, -1) + 0.5)
    reach = 0.5 * CELL
    is_near = (centers[..., 0] > face - reach) & (centers[..., 0] < face + width + reach)
    free = all_free() & ~(is_near & (centers[..., 1] < end + reach))
    room = room_of(Body(radius), voxels, free)
    x, y = np.meshgrid(*[np.arange(0.0125, SIZE, 0.025)] * 2, indexing="ij")
    places = np.stack([x, y], axis=-1).reshape(-1, 2)
    places = places[room.fits(places)]
    low, high = np.array([face, -1.0]), np.array([face + width, end])
    gap = np.linalg.norm(np.maximum(0.0, np.maximum(low - places, places - high)), axis=1)
    assert gap.min() >= radius - VOXEL  # the map is no finer


def test_unknown_floor_is_trusted_round_the_first_place_only():
    free = all_free()
    free[:, :, 1] = False  # nothing is known of the lowest layer, but for the floor's voxels
    seen = floor_voxels()
    away = np.hypot(seen[:, 0] - 1.5, seen[:, 1] - 2.0)
    ring = seen[(away > 0.8) & (np.abs(seen[:, 0] - 3.0) > 0.3)]
    camera = Camera(64, 48, 60.0, 40.0, 32.0, 24.0)  # sees the floor from 0.83 m on
    grid = grid_of(free)
    room = room_for(Body(0.2), grid, ring, VOXEL, pose_at(1.5, 2.0), camera)
    assert np.isfinite(room.cost[12]).any()  # off the place where it started
    assert not np.isfinite(room.cost[17:]).any()  # not over a strip of which nothing was seen
    first = Been(views=np.array([[0.5, 0.5, HEIGHT, 1.0, 0.0, 0.0]]))
    room = room_for(Body(0.2), grid, ring, VOXEL, pose_at(1.5, 2.0), camera, first)
    assert not np.isfinite(room.cost[12]).any()


corners = st.lists(st.tuples(*[st.integers(2, 17)] * 2), min_size=2, max_size=5, unique=True)


@given(corners=corners, radius=st.floats(0.1, 0.35))
@settings(max_examples=30, deadline=None)
def test_a_driven_path_leads_back_until_something_is_measured_on_it(corners, radius):
    """Whatever the cells say: nothing is known here but the surroundings of its beginning."""
    path = (np.array(corners) + 0.5) * CELL
    first = tuple(np.floor((path[0] + CELL) / CELL).astype(int))
    free = np.zeros(SHAPE, bool)
    free[tuple(slice(i - 2, i + 3) for i in first)] = True
    grid = grid_of(free)
    travel = plan_travel(grid, np.append(path[-1], HEIGHT), 0.1)
    driven = driven_pixels(travel, np.column_stack([path, np.full(len(path), HEIGHT)]))

    def back(driven, *things) -> float:
        body, voxels = Body(radius, floor=0.0), np.concatenate([np.zeros((0, 3)), *things])
        return room_for(
            body, grid, voxels, VOXEL, pose_at(*path[-1]), been=Been(driven=driven)
        ).cost[first]  # fmt: skip

    length = sum(np.linalg.norm(b - a) for a, b in itertools.pairwise(path))
    assert back(driven) <= 1.42 * length + CELL  # over pixels: at most along both axes
    if np.linalg.norm(path[0] - path[-1]) > 2.0:
        assert not np.isfinite(back(None))
        ring = [(x, y) for x in range(-13, 14) for y in range(-13, 14) if max(abs(x), abs(y)) == 13]
        assert not np.isfinite(
            back(driven, *[pole(*(path[0] + VOXEL * np.array(p))) for p in ring])
        )


@pytest.mark.parametrize("height", [0.2, HEIGHT])
def test_a_thin_thing_that_the_map_does_not_hold_is_an_obstacle(height):
    """Also of a body that is no taller than the cells that hold the floor."""
    log_odds = np.array(grid_of(all_free()).log_odds)
    log_odds[:, :, :2] = 3.0  # the floor
    log_odds[16, :, 2] = 3.0
    grid = OccupancyGrid(
        jnp.asarray(log_odds), jnp.full(3, -CELL, jnp.float32), jnp.asarray(CELL, jnp.float32)
    )
    room = room_for(Body(0.2), grid, floor_voxels(), VOXEL, pose_at(2.0, 2.0, height))
    assert np.isfinite(room.cost[14]).any()
    assert not np.isfinite(room.cost[18:]).any()


@pytest.mark.parametrize("height", [0.3, 0.9, 1.2])
def test_a_camera_that_looks_down_trusts_the_floor_near_its_views_only(height):
    """From afar its image ends below a shelf or a desk, and shows the floor below it."""
    free = all_free()
    free[:, :, :2] = False  # nothing is known of the lowest layer, but for the floor's voxels
    camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0)  # 22 degrees up and down
    down = pose_at(1.0, 2.0, height)
    angle = np.radians(30.0)
    level = down[:3, :3].copy()
    down[:3, 2] = np.cos(angle) * level[:, 2] - np.sin(angle) * np.array([0.0, 0.0, 1.0])
    down[:3, 1] = np.cross(down[:3, 2], level[:, 0])
    opened = lambda pose, views=None: room_for(
        Body(0.1), grid_of(free), floor_voxels(), VOXEL, pose, camera, Been(views=views)
    ).fits(np.array([[1.4, 2.0], [2.4, 2.0], [3.4, 2.0]]))
    np.testing.assert_array_equal(opened(pose_at(1.0, 2.0, height)), [True, True, True])
    np.testing.assert_array_equal(opened(down), [True, False, False])
    toward = np.array([[x, 2.0, height, 1.0, 0.0, 0.0] for x in (1.0, 2.0)])
    away = toward * [[1.0] * 6, [1.0, 1.0, 1.0, -1.0, 1.0, 1.0]]
    np.testing.assert_array_equal(opened(down, toward), [True, True, False])
    np.testing.assert_array_equal(opened(down, away), [True, False, False])


@pytest.mark.parametrize("top", [0.5, 0.75, 1.0])
def test_the_top_of_a_table_is_not_the_floor(top):
    """A level camera at 1.5 m shows it long before it shows the floor."""
    voxels = floor_voxels(lambda x, y: 0.0 * x + top + VOXEL)
    voxels = voxels[np.all((voxels[:, :2] > 1.8) & (voxels[:, :2] < 3.0), axis=1)]
    y = np.arange(0.025, SIZE, VOXEL)
    wall = [pole(SIZE - 0.025, v, 0.3, 2.0) for v in y]
    room = room_for(
        Body(0.2), grid_of(all_free()), np.concatenate([voxels, *wall]), VOXEL,
        pose_at(0.5, 0.5, 1.5),
    )  # fmt: skip
    assert room.floor[3, 3] == pytest.approx(0.0, abs=1e-6)
    assert not room.fits(np.array([[2.4, 2.4]])).any()


def test_the_landing_of_a_stair_is_the_floor():
    """Where the floor below can be seen, too."""
    lower = floor_voxels()
    landing = lower[lower[:, 0] < 3.0] + [0.0, 0.0, 1.0]
    below = lower[lower[:, 0] > 3.4]
    voxels = np.concatenate([landing, below])
    room = room_for(Body(0.2), grid_of(all_free()), voxels, VOXEL, pose_at(1.0, 2.0, 1.0 + HEIGHT))
    assert room.floor[6, 11] == pytest.approx(1.0, abs=VOXEL)


def test_what_a_costmap_holds_for_free_is_entered_unseen_but_not_what_was_measured_there():
    free = np.zeros(SHAPE, bool)
    free[3:6, 10:13] = True  # round the robot; nothing else is known
    trusted = np.zeros(SHAPE, bool)
    trusted[3:12, 9:14] = True
    body, pose = Body(0.2, floor=0.0), pose_at(0.8, 2.0)
    place = np.array([[1.9, 2.0]])
    plan = lambda grid, voxels: room_for(body, grid, voxels, VOXEL, pose)
    grid = grid_of(free)
    assert not plan(grid, np.zeros((0, 3))).fits(place).any()
    known = grid.marked(trusted, TRUSTED)
    room = plan(known, np.zeros((0, 3)))
    assert room.fits(place).all()
    assert np.isfinite(room.cost[9, 11])
    assert not np.isfinite(room.cost[13:]).any()
    assert not plan(known, pole(1.9, 2.0)).fits(place).any()


def test_a_polygon_needs_the_room_to_turn():
    square = Body(((0.3, 0.2), (0.3, -0.2), (-0.3, -0.2), (-0.3, 0.2)))
    assert square.radius == pytest.approx(np.hypot(0.3, 0.2))


@pytest.mark.parametrize(
    "settings",
    [
        {"footprint": 0.0},
        {"footprint": ((0.0, 0.0), (1.0, 0.0))},
        {"footprint": float("nan")},
        {"heights": (0.5, 0.2)},
        {"margin": -0.1},
    ],
)
def test_a_body_that_cannot_be_is_refused_by_name(settings):
    with pytest.raises(ValueError, match=next(iter(settings)).split("_")[0]):
        Body(**settings)


def test_a_recorded_motion_has_its_body_again():
    body = Body(((0.3, 0.2), (0.3, -0.2), (-0.3, 0.0)), heights=(0.0, 0.9), unknown_below="never")
    motion = make_motion("ground", body=body)
    assert motion_of_record(plain_settings(motion)) == motion
    assert motion_of_record({"body": 1.0}).body == 1.0  # of earlier versions


def test_a_level_camera_finds_the_floor_that_it_sees_from_afar():
    """Walls have as many voxels at every height, and the box ends below the floor."""
    y = np.arange(0.025, SIZE, VOXEL)
    walls = [pole(x, v, 0.0, 2.0) for x in (0.025, SIZE - 0.025) for v in y]
    far = floor_voxels()
    far = far[far[:, 0] > 2.8]
    grid = grid_of(all_free())
    voxels = np.concatenate([far, *walls]) + np.array([0.0, 0.0, 0.35])
    room = room_for(Body(0.2), grid, voxels, VOXEL, pose_at(0.5, 2.0, 1.65))
    assert np.median(room.floor) == pytest.approx(np.median(far[:, 2]) + 0.35, abs=VOXEL)
