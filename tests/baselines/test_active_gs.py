"""Active-GS's utility, regions of interest and candidates, against loops in float64 and by hand."""

import itertools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import r3jax
from r3jax.baselines import active_gs
from r3jax.baselines.active_gs import ActiveGS
from r3jax.baselines.confidence import no_sightings
from r3jax.baselines.pixels import PixelView
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera, pose_along
from r3jax.mapping.join import grow
from r3jax.planning.candidates import candidates_along
from r3jax.planning.config import PlannerConfig
from r3jax.planning.policy import DecisionOutcome, Situation
from r3jax.planning.robot.travel import plan_travel
from tests.planning.rooms import CELL, ORIGIN, center, grid_of, pose_at, two_rooms

pytestmark = pytest.mark.full

KEY = jax.random.key(5)
CAMERA = Camera.from_fov(32, 32)
NUM, AIMED = 60, 30
CONFIG = PlannerConfig(num_candidates=NUM, num_frontier=AIMED)
CAPACITY, VOXEL = 1 << 12, 0.05
START = center(6, 6, 4)


def map_of(points: np.ndarray) -> r3jax.MapState:
    points = np.asarray(points, np.float32)
    rgb = np.full_like(points, 0.5)
    state = r3jax.empty_map(CAPACITY, VOXEL)
    return r3jax.integrate_points(state, points, rgb, START.astype(np.float32))


def sightings_of(state, confidence=None, normal=None):
    """Sightings with a given confidence and normals per row: one view each, from straight ahead."""
    seen = no_sightings(state.capacity)
    if normal is None:
        normal = np.tile([[1.0], [0.0], [0.0]], state.capacity)
    if confidence is None:
        confidence = np.zeros(state.capacity)
    as_float = lambda x: jnp.asarray(x, jnp.float32)
    return type(seen)(
        key=state.key,
        views=seen.views + 1.0,
        direction_sum=seen.direction_sum.at[0].set(1.0),
        cosine_sum=as_float(confidence),
        normal_sum=as_float(normal),
    )


# ---- pixels ----------------------------------------------------------------------------------


def some_view() -> PixelView:
    random = np.random.default_rng(2)
    shape = (6, 8)
    hit = random.random(shape) < 0.8
    return PixelView(
        hit=jnp.asarray(hit),
        depth=jnp.asarray(np.where(hit, random.uniform(0.2, 8.0, shape), np.inf), jnp.float32),
        offset=jnp.zeros((3, *shape)),
        rows=jnp.asarray(random.random(shape), jnp.float32),
        cells=jnp.asarray(17.0),
        max_range=jnp.asarray(5.0),
    )


def test_pixels() -> None:
    view = some_view()
    hit, depth, confidence = (np.asarray(x, float) for x in (view.hit, view.depth, view.rows))
    near = far = nothing = 0
    expected = []
    for i, j in np.ndindex(hit.shape):
        d, c = depth[i, j], confidence[i, j]
        if not hit[i, j]:
            d, c, nothing = 2.5, 0.0, nothing + 1
        elif d > 5.0:
            c, far = 1.0, far + 1
        else:
            near += 1
        expected.append((1.0 - c) * d / 5.0)
    assert min(near, far, nothing) > 5
    cells, rendering = active_gs.cells_and_doubt(view)
    assert float(cells) == 17.0
    np.testing.assert_allclose(float(rendering), np.mean(expected), rtol=1e-5)


def wall_at(distance: float) -> tuple:
    """A wall of 6 x 6 m square to the x axis, its voxels' centers that far from the start."""
    across = np.arange(-1.9, 1.9, VOXEL) + 0.5 * VOXEL
    y, z = np.meshgrid(across, across)
    # The start lies in the middle of a voxel, so that distances between centers are exact.
    points = START + np.stack([np.full(y.size, distance), y.ravel(), z.ravel()], axis=1)
    state = r3jax.integrate_points(
        r3jax.empty_map(1 << 14, VOXEL),
        points.astype(np.float32),
        np.full(points.shape, 0.5, np.float32),
        START.astype(np.float32),
    )
    return state


def score(policy_class, state, confidence, grid=None, direction=(1.0, 0.0, 0.0)):
    if grid is None:
        grid = grid_of(np.ones((40, 14, 10), bool))
    travel = plan_travel(grid, START)
    seen = sightings_of(state, np.full(state.capacity, confidence))
    situation = Situation(state, grid, grid, travel, CAMERA, seen)
    candidates = candidates_along(np.tile(START, (2, 1)), np.tile(direction, (2, 1)))
    return policy_class(CONFIG).score(situation, candidates, key=KEY)[1]


def test_scores() -> None:
    """Square on to a wall: (1 - C) d / d_max, to half a voxel; nothing known: one half."""
    module = active_gs
    wall = wall_at(3.0)
    u = score(module.ActiveGS, wall, 0.25)
    np.testing.assert_allclose(u["rendering"], 0.75 * 3.0 / 5.0, atol=0.01)
    np.testing.assert_array_equal(u["exploration"], 0.0)
    np.testing.assert_allclose(u["utility"], u["rendering"])
    away = score(module.ActiveGS, wall, 0.25, direction=(-1.0, 0.0, 0.0))
    np.testing.assert_allclose(away["rendering"], 0.5, atol=1e-5)
    assert u["lot"].shape == (2,)


def test_far_walls() -> None:
    """A known wall out of range promises nothing; unexplored cells out of range do not count."""
    known = np.ones((50, 14, 10), bool)
    known[34:36, 4:9, 2:7] = False  # from 5.5 m on
    grid = grid_of(known)
    wall = wall_at(8.0)
    u = score(active_gs.ActiveGS, wall, 0.0, grid)
    np.testing.assert_array_equal(u["exploration"], 0.0)
    # The wall covers 3.8 m of 9.2 m across the picture, squared; the rest shows nothing.
    share = (3.8 / (2 * 8.0 * np.tan(np.deg2rad(30.0)))) ** 2
    np.testing.assert_allclose(u["rendering"], 0.5 * (1.0 - share), atol=0.02)


def test_exploration() -> None:
    """Four unexplored cells in plain view of 40 x 14 x 10."""
    known = np.ones((40, 14, 10), bool)
    known[14:16, 6:8, 4] = False
    u = score(active_gs.ActiveGS, map_of(center(30, 6, 4)[None]), 1.0, grid_of(known))
    np.testing.assert_allclose(u["exploration"], 4 / 5600)
    np.testing.assert_allclose(u["utility"], 1000 * 4 / 5600 + u["rendering"])


# ---- regions ---------------------------------------------------------------------------------


def some_world():
    """The two rooms, part of them unknown, with voxels of mixed confidence on random spots."""
    free, occupied = two_rooms()
    random = np.random.default_rng(3)
    outer = np.ones(free.shape, bool)
    outer[2:22, 2:12, 2:7] = False
    hidden = outer & (random.random(free.shape) < 0.3)
    grid = grid_of(free & ~hidden, occupied & ~hidden)
    spots = random.integers((0, 0, 0), (25, 14, 10), (60, 3))
    points = (center(0, 0, 0) + spots * CELL)[:, None, :] + random.uniform(-0.09, 0.09, (60, 20, 3))
    outside = ORIGIN + random.uniform(-0.5, -0.2, (20, 3))
    state = map_of(np.concatenate([points.reshape(-1, 3), outside]))
    confidence = random.uniform(0.0, 0.8, state.capacity)
    normal = random.normal(size=(3, state.capacity))
    return grid, state, sightings_of(state, confidence, normal)


def test_regions() -> None:
    module = active_gs
    grid, state, seen = some_world()
    free, unexplored = np.asarray(grid.free), np.asarray(grid.unexplored)
    count, total = module.low_confidence(state, seen, grid)
    expected_count = np.zeros(free.shape, int)
    expected_total = np.zeros((3, *free.shape))
    centers = np.asarray(state.center, float)
    confidence, normals = np.asarray(seen.confidence), np.asarray(seen.normal, float)
    for row in np.flatnonzero(np.asarray(state.occupied)):
        cell = np.floor((centers[:, row] - ORIGIN) / CELL).astype(int)
        if confidence[row] < 0.3 and np.all((cell >= 0) & (cell < free.shape)):
            expected_count[tuple(cell)] += 1
            expected_total[(slice(None), *cell)] += normals[:, row]
    np.testing.assert_array_equal(count, expected_count)
    np.testing.assert_allclose(total, expected_total, atol=1e-4)
    found = module.regions_of(free, unexplored, np.asarray(count), np.asarray(total))
    sides = {tuple(cell): normal for cell, normal in zip(found.cells, found.normals, strict=True)}
    both = set()
    for cell in np.ndindex(free.shape):
        to_free = np.zeros(3)
        num_free = 0
        for axis, sign in itertools.product(range(3), (-1, 1)):
            other = np.array(cell)
            other[axis] += sign
            if np.all((other >= 0) & (other < free.shape)) and free[tuple(other)]:
                to_free[axis] += sign
                num_free += 1
        is_region = num_free > 0 and (unexplored[cell] or expected_count[cell] > 5)
        assert is_region == (cell in sides), cell
        if is_region:
            side = to_free if unexplored[cell] else expected_total[(slice(None), *cell)]
            length = np.linalg.norm(side)
            both.add((bool(unexplored[cell]), length > 0))
            np.testing.assert_allclose(sides[cell], side / (length or 1.0), atol=1e-3)
    assert {(True, True), (False, True), (True, False)} <= both


def test_aims() -> None:
    """Every candidate keeps every rule; the nearest regions come first; nobody is left out."""
    module = active_gs
    grid, state, seen = some_world()
    travel = plan_travel(grid, START)
    count, total = (np.asarray(x) for x in module.low_confidence(state, seen, grid))
    found = module.regions_of(travel.free, np.asarray(grid.unexplored), count, total)
    side_of = {tuple(c): n for c, n in zip(found.cells, found.normals, strict=True)}
    places, aims = module.aimed_views(travel, found, AIMED, key=KEY)
    assert places.shape == aims.shape == (AIMED, 3)
    away = np.linalg.norm(aims - START, axis=1)
    assert np.all(np.diff(away) > -1e-9)
    numbers: dict[tuple, int] = {}
    for place, aim in zip(places, aims, strict=True):
        cell = travel.cell_of(aim)
        numbers[cell] = numbers.get(cell, 0) + 1
        np.testing.assert_allclose(aim, center(*cell), atol=1e-6)
        assert travel.goals[travel.cell_of(place)]
        assert np.abs(place - center(*travel.cell_of(place))).max() <= 0.25 * CELL + 1e-6
        distance = np.linalg.norm(place - aim)
        line = place + np.linspace(0, 1, 400)[:, None] * (aim - place)
        crossed = [travel.cell_of(point) for point in line]
        blocked = np.array([not travel.free[c] and c != cell for c in crossed])
        # A line may graze a cell for less than a quarter of its edge.
        longest = max((len(list(g)) for k, g in itertools.groupby(blocked) if k), default=0)
        assert longest * distance / 399 <= 0.25 * CELL + 0.01
    assert max(numbers.values()) == 5
    for place, aim in zip(*module.aimed_views(travel, found, 600, key=KEY), strict=True):
        distance, side = np.linalg.norm(place - aim), side_of[travel.cell_of(aim)]
        assert 0.3 <= distance <= 2.0
        assert not side.any() or side @ (place - aim) >= 0.5 * distance - 1e-9
    bare, axis = plan_travel(grid_of(*two_rooms()), START), np.array([0.6, 0.0, 0.8])
    open_space = module.Regions(np.array([[5, 6, 3]]), axis[None])
    for i in range(60):
        places, aims = module.aimed_views(bare, open_space, 5, key=jax.random.key(i))
        assert np.all((places - aims) @ axis >= 0.5 * np.linalg.norm(places - aims, axis=1))
    few, _ = module.aimed_views(travel, found, 7, key=KEY)
    assert len(few) == 7
    nothing = module.Regions(found.cells[:0], found.normals[:0])
    assert module.aimed_views(travel, nothing, AIMED, key=KEY)[0].shape == (0, 3)
    # A cell of a bare wall gets its five from the front and none from behind.
    for side, expected in ((1.0, 5), (0.0, 5), (-1.0, 0)):
        one = module.Regions(np.array([[0, 6, 4]]), np.array([[side, 0.0, 0.0]]))
        assert len(module.aimed_views(bare, one, AIMED, key=KEY)[0]) == expected


# ---- decisions -------------------------------------------------------------------------------


def flat():
    """Two rooms, all known but the far half of the second one."""
    free, occupied = two_rooms()
    known = (np.arange(25) < 18)[:, None, None]
    return grid_of(free & known, occupied & known)


def decide(state, grid, policy_class=ActiveGS, memory=None, position=START, key=KEY):
    chooser = policy_class(CONFIG)
    start = chooser.init(CAMERA, grid, key=KEY)
    if memory is not None:
        start = replace(start, memory=memory)
    return chooser.decide(start, state, grid, pose_at(position), key=key)


@pytest.mark.parametrize("policy_class", [ActiveGS])
def test_a_decision_has_all_candidates_and_follows_the_score(policy_class):
    state = map_of(center(0, 6, 4)[None])
    decision, after, info = decide(state, flat(), policy_class)
    assert info.outcome is DecisionOutcome.MOVED
    assert decision.candidates.shape == (NUM, 4, 4)
    u = decision.utilities
    share = u["utility"] / u["utility"].sum() - 0.5 * u["path"] / u["path"].sum()
    np.testing.assert_allclose(u["total"], share, rtol=1e-9)
    np.testing.assert_allclose(u["utility"], 1000 * u["exploration"] + u["rendering"])
    assert u["exploration"].max() > 0.0
    assert after.memory.views.shape == (state.capacity,)
    # Local views are within reach of the arm; those of the frontier need not be.
    near = np.linalg.norm(decision.candidates[:, :3, 3] - START, axis=1) <= 0.5
    assert near.sum() >= NUM - AIMED


def test_cells_of_low_confidence_are_aimed_at_until_they_are_believed_in():
    """A patch of the wall behind the robot, in a world without anything unexplored."""
    grid = grid_of(*two_rooms())
    random = np.random.default_rng(0)
    patch = center(0, 6, 4) + random.uniform(-0.09, 0.09, (40, 3)) + [0.05, 0.0, 0.0]
    state = map_of(patch)
    looks_there = lambda decision: sum(
        np.linalg.norm(np.cross(pose[:3, 2], center(0, 6, 4) - pose[:3, 3])) < 1e-3
        for pose in decision.candidates
    )
    doubted, _, _ = decide(state, grid, memory=sightings_of(state))
    assert looks_there(doubted) == 5
    believed, _, _ = decide(state, grid, memory=sightings_of(state, np.ones(CAPACITY)))
    assert looks_there(believed) == 0
    assert believed.candidates.shape == (NUM, 4, 4)


def test_nothing_of_use_is_a_random_choice():
    utilities = {
        "utility": np.array([0.0, 0.0, 0.0, 5.0]),
        "path": np.array([1.0, 2.0, 3.0, np.inf]),
        "lot": np.array([0.3, 0.9, 0.1, 1.0]),
    }
    np.testing.assert_array_equal(
        ActiveGS(CONFIG).weigh(utilities), np.array([0.3, 0.9, 0.1, -np.inf])
    )
    utilities["utility"][1] = 2.0
    np.testing.assert_allclose(
        ActiveGS(CONFIG).weigh(utilities), [-0.5 / 6, 1.0 - 1.0 / 6, -0.25, -np.inf]
    )


def test_lots_differ_between_decisions():
    state = wall_at(3.0)
    grid = grid_of(np.ones((40, 14, 10), bool))
    views = candidates_along(np.tile(START, (8, 1)), np.tile([1.0, 0.0, 0.0], (8, 1)))
    travel = plan_travel(grid, START)
    situation = Situation(state, grid, grid, travel, CAMERA, sightings_of(state))
    lots = [ActiveGS(CONFIG).score(situation, views, key=jax.random.key(i))[1]["lot"]
            for i in range(2)]  # fmt: skip
    assert len(np.unique(np.concatenate(lots))) == 16


def test_shut_in_all_candidates_are_the_robots_own_place():
    free = np.zeros((25, 14, 10), bool)
    free[6, 6, 4] = True
    decision, _, info = decide(map_of(START[None]), grid_of(free, ~free))
    assert info.outcome is DecisionOutcome.MOVED
    assert decision.candidates.shape == (NUM, 4, 4)
    np.testing.assert_allclose(decision.candidates[:, :3, 3], np.tile(START, (NUM, 1)))
    nowhere, _, info = decide(map_of(START[None]), grid_of(np.zeros((25, 14, 10), bool)))
    assert nowhere is None
    assert info.outcome is DecisionOutcome.NO_CANDIDATE


@pytest.mark.full
def test_what_was_observed_counts_in_the_decision_even_if_the_map_grew_since():
    """Seen square on three times, the wall promises less: also to a map with other rows."""
    chooser = ActiveGS(CONFIG)
    grid = flat()
    pose = np.asarray(pose_along(START, np.array([-1.0, 0.0, 0.0])))
    depth = np.full((32, 32), 1.1, np.float32)
    frame = Frame(np.full((32, 32, 3), 0.5, np.float32), depth, pose, CAMERA)
    state, memory = r3jax.empty_map(CAPACITY, VOXEL), chooser.init(CAMERA, grid, key=KEY)
    values = []
    for _ in range(3):
        state = r3jax.integrate(state, frame)
        memory = chooser.observe(memory, state, frame)
        assert float(memory.memory.confidence.max()) > 0.7
        larger = grow(state, 4 * CAPACITY)
        utilities = [
            chooser.decide(memory, m, grid, pose.astype(float), key=KEY)[0].utilities["rendering"]
            for m in (state, larger)
        ]
        np.testing.assert_allclose(*utilities, atol=1e-3)  # ties in the depth buffer
        values.append(utilities[0])
    assert values[2].mean() < values[0].mean()
