"""Travel: hand cases, a brute-force Dijkstra, and paths that never leave safe cells.

Mutants tried by hand, each caught here: diagonal steps past a corner; a margin of one cell too few;
the grid's border taken as free; a shortcut that is not checked; end pieces left out of the
length; the robot's own cell not usable; the trail usable from a safe cell too.
"""

import heapq
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from skimage.graph import MCP_Geometric

from r3jax.errors import InputError
from r3jax.kernels.robot.cells import segment_cells
from r3jax.planning.robot.travel import plan_travel, safe_cells, segment_is_inside
from tests.planning.rooms import CELL, ORIGIN, center, grid_of, two_rooms

SHAPE = (9, 8, 6)


@st.composite
def cluttered(draw) -> tuple[np.ndarray, tuple[int, int, int]]:
    """Free cells of a small space with random obstacles, and a cell to start from."""
    free = np.ones(SHAPE, dtype=bool)
    blocked = draw(st.lists(st.integers(0, free.size - 1), max_size=60))
    free.reshape(-1)[blocked] = False
    return free, tuple(draw(st.integers(0, n - 1)) for n in SHAPE)


def brute_force(usable: np.ndarray, start: tuple[int, ...]) -> np.ndarray:
    """Lengths [cells] by a plain Dijkstra that checks each step's block cell by cell."""
    best = np.full(usable.shape, np.inf)
    best[start] = 0.0
    queue = [(0.0, start)]
    while queue:
        length, cell = heapq.heappop(queue)
        if length > best[cell]:
            continue
        for step in itertools.product((-1, 0, 1), repeat=3):
            block = [
                tuple(np.add(cell, part)) for part in itertools.product(*({0, d} for d in step))
            ]
            inside = all(0 <= i < n for c in block for i, n in zip(c, usable.shape, strict=True))
            if not any(step) or not inside or not all(usable[c] for c in block):
                continue
            head, longer = tuple(np.add(cell, step)), length + float(np.linalg.norm(step))
            if longer < best[head] - 1e-12:
                best[head] = longer
                heapq.heappush(queue, (longer, head))
    return best


def assert_inside(mask: np.ndarray, waypoints: np.ndarray) -> None:
    """Every point of a path, sampled each 2 mm, lies in a cell of the mask."""
    for a, b in itertools.pairwise(waypoints):
        steps = max(2, int(np.linalg.norm(b - a) / 0.002))
        points = a + np.linspace(0, 1, steps)[:, None] * (b - a)
        cells = np.floor((points - ORIGIN) / CELL).astype(int)
        assert mask[tuple(cells.T)].all()


def test_safe_cells_keep_a_ball_free_of_everything_not_known():
    """The definition, cell by cell: distance from the center to the nearest cell not free."""
    rng = np.random.default_rng(0)
    free = rng.random(SHAPE) > 0.03
    for margin in (0.0, 0.1, 0.25, 0.3, 0.45):
        safe = safe_cells(free, CELL, margin)
        padded = np.pad(free, 4)
        blocked = np.argwhere(~padded) - 4
        for cell in np.argwhere(free):
            gap = np.maximum(np.abs(blocked - cell) - 0.5, 0.0) * CELL
            clearance = np.linalg.norm(gap, axis=1).min()
            assert safe[tuple(cell)] == (clearance >= margin - 1e-6)
    assert safe_cells(free, CELL, 0.0).sum() == free.sum()
    assert not safe_cells(free, CELL, 0.3)[~free].any()


def test_lengths_through_an_open_room_are_the_straight_ones():
    travel = plan_travel(grid_of(np.ones((16, 12, 8), bool)), center(2, 2, 2))
    assert travel.distance((2, 2, 2)) == pytest.approx(0.0, abs=1e-6)
    assert travel.distance((7, 2, 2)) == pytest.approx(1.0)
    assert travel.distance((7, 7, 2)) == pytest.approx(np.sqrt(2.0))
    assert travel.distance((4, 5, 6)) == pytest.approx(CELL * (2 * 3**0.5 + 2**0.5 + 1))
    assert travel.distance((0, 2, 2)) == np.inf  # at the border: beyond it nothing is known
    assert travel.distance((99, 2, 2)) == np.inf
    goal = center(11.15, 6.75, 3.2)
    waypoints = travel.path(goal)
    np.testing.assert_array_equal(waypoints, np.stack([center(2, 2, 2), goal]))
    assert travel.lengths(goal[None])[0] == pytest.approx(np.linalg.norm(goal - center(2, 2, 2)))


def test_the_way_to_the_next_room_leads_through_the_door():
    free, occupied = two_rooms()
    start, goal = center(3, 3, 2), center(21, 3, 3) + 0.04
    travel = plan_travel(grid_of(free, occupied), start)
    waypoints = travel.path(goal)
    np.testing.assert_array_equal(waypoints[0], start)
    np.testing.assert_array_equal(waypoints[-1], goal)
    assert_inside(travel.safe, waypoints)
    in_door = np.argwhere(travel.cells_along(waypoints)[12])
    assert np.all((in_door[:, 0] >= 5) & (in_door[:, 0] <= 7))
    length = np.linalg.norm(np.diff(waypoints, axis=0), axis=1).sum()
    assert np.linalg.norm(goal - start) < length <= travel.lengths(goal[None])[0] + 1e-9
    over_centers = travel.distance((21, 3, 3)) + np.linalg.norm(goal - center(21, 3, 3))
    assert travel.lengths(goal[None])[0] == pytest.approx(over_centers)
    assert len(waypoints) <= 6


def test_a_closed_door_cannot_be_passed():
    free, occupied = two_rooms()
    free[12] = False
    travel = plan_travel(grid_of(free, occupied), center(3, 3, 3))
    assert not travel.reachable[13:].any()
    assert travel.lengths(center(20, 6, 4)[None])[0] == np.inf
    with pytest.raises(InputError):
        travel.path(center(20, 6, 4))


def test_unknown_space_is_an_obstacle():
    free, occupied = two_rooms()
    free[8, :, :] = False  # neither free nor occupied
    travel = plan_travel(
        grid_of(free, occupied & (np.arange(25) != 8)[:, None, None]), center(3, 3, 3)
    )
    assert not travel.reachable[7:].any()


@settings(max_examples=10)  # the oracle takes half a second
@given(cluttered())
def test_lengths_match_a_brute_force_dijkstra(world):
    free, start = world
    # A margin of zero keeps this small space open: safe cells are the free ones.
    travel = plan_travel(grid_of(free), center(*start), safety_margin=0.0)
    usable = free.copy()
    usable[start] = True
    np.testing.assert_allclose(travel.cost, brute_force(usable, start) * CELL, atol=1e-9)


@given(cluttered())
def test_forbidding_squeezes_only_lengthens_scikit_images_ways(world):
    free, start = world
    travel = plan_travel(grid_of(free), center(*start), safety_margin=0.0)
    costs = np.where(travel.usable, 1.0, -1.0)
    theirs, _ = MCP_Geometric(costs, sampling=(CELL,) * 3).find_costs([start])
    assert np.all(travel.cost >= theirs - 1e-9)


@given(cluttered(), st.integers(0, 2**31))
def test_paths_never_leave_safe_cells(world, seed):
    free, start = world
    rng = np.random.default_rng(seed)
    position = center(*start) + rng.uniform(-0.09, 0.09, 3)
    travel = plan_travel(grid_of(free), position, safety_margin=0.0)
    cells = np.argwhere(travel.reachable)
    for cell in cells[rng.integers(len(cells), size=3)]:
        goal = center(*cell) + rng.uniform(-0.09, 0.09, 3)
        waypoints = travel.path(goal)
        np.testing.assert_array_equal(waypoints[[0, -1]], np.stack([position, goal]))
        assert_inside(travel.usable, waypoints)
        length = np.linalg.norm(np.diff(waypoints, axis=0), axis=1).sum()
        assert length <= travel.lengths(goal[None])[0] + 1e-9
        assert length <= travel.distance(cell) + np.linalg.norm(goal - center(*cell)) + 1e-9


def test_no_squeezing_between_two_corners():
    free = np.ones((4, 4, 3), bool)
    free[1, 2] = free[2, 1] = False
    travel = plan_travel(grid_of(free), center(1, 1, 1), safety_margin=0.0)
    assert travel.distance((2, 2, 1)) > 4 * CELL  # round the pillars, not between them
    assert_inside(travel.usable, travel.path(center(2, 2, 1)))


def test_the_own_cell_is_usable_even_if_it_is_not_safe():
    free, occupied = two_rooms()
    travel = plan_travel(grid_of(free, occupied), center(1, 3, 3))  # beside the wall
    assert not travel.safe[1, 3, 3]
    assert travel.goals[1, 3, 3]
    assert travel.reachable[20, 6, 4]
    unknown = plan_travel(grid_of(np.zeros(SHAPE, bool)), center(3, 3, 3))
    assert unknown.reachable.sum() == 1
    assert not unknown.goals.any()


def test_a_robot_that_finds_itself_shut_in_may_go_back():
    free, occupied = two_rooms()
    free[12, 4] = free[12, 8] = False  # the door turns out to be three cells wide, ...
    free[12, 5] = False  # ... then two
    start = center(12, 6, 4)
    shut = plan_travel(grid_of(free, occupied), start)
    assert shut.reachable.sum() == 1
    trail = shut.cells_along(np.stack([center(9, 6, 4), start]))
    back = plan_travel(grid_of(free, occupied), start, trail=trail)
    assert back.reachable[9, 6, 4]
    assert_inside(back.safe | trail, back.path(center(5, 6, 4)))
    # What turned out to be occupied stays shut, trail or not.
    blocked = trail & (np.arange(25) == 11)[:, None, None]
    assert (
        not plan_travel(grid_of(free, occupied | blocked), start, trail=trail).reachable[10].any()
    )
    # From a safe cell the trail opens nothing.
    outside = plan_travel(grid_of(free, occupied), center(9, 6, 4), trail=trail)
    np.testing.assert_array_equal(outside.usable, outside.safe)


def test_outside_the_grid_nothing_is_reachable():
    travel = plan_travel(grid_of(np.ones(SHAPE, bool)), np.array([100.0, 0.0, 0.0]))
    assert not travel.reachable.any()
    assert not travel.goals.any()
    with pytest.raises(InputError):
        plan_travel(grid_of(np.ones(SHAPE, bool)), np.array([np.nan, 0.0, 0.0]))


@given(
    hnp.arrays(np.float64, (2, 3), elements=st.floats(0.01, 4.99)),
    hnp.arrays(bool, (5, 5, 5)),
)
def test_a_segment_crosses_the_cells_of_its_points(ends, mask):
    a, b = ends
    points = a + np.linspace(0, 1, 400)[:, None] * (b - a)
    sampled = {tuple(c) for c in np.floor(points).astype(int)}
    crossed = {tuple(c) for c in segment_cells(a, b)}
    assert sampled <= crossed
    if not all(mask[c] for c in sampled):
        assert not segment_is_inside(mask, a, b)
    assert segment_is_inside(np.ones((5, 5, 5), bool), a, b) or crossed - set(np.ndindex(5, 5, 5))


def test_a_segment_through_a_corner_touches_all_its_cells():
    mask = np.ones((2, 2, 1), bool)
    assert segment_is_inside(mask, np.array([0.5, 0.5, 0.5]), np.array([1.5, 1.5, 0.5]))
    mask[0, 1] = False
    assert not segment_is_inside(mask, np.array([0.5, 0.5, 0.5]), np.array([1.5, 1.5, 0.5]))
    assert not segment_is_inside(mask, np.array([0.5, 0.5, 0.5]), np.array([2.5, 0.5, 0.5]))
