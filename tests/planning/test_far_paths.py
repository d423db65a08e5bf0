"""The coarse level: paths over tiles are those over cells, no more and no fewer."""

import itertools

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from r3jax.kernels.robot.shortest_paths import shortest_paths
from r3jax.mapping.tiles import Lattice
from r3jax.planning.far_paths import (
    FREE,
    GIVEN_UP,
    OCCUPIED,
    Clearance,
    Coarse,
    cell_of,
    connected_within,
    known_cells,
    lengths_from,
    path_along,
    refreshed,
    with_closed,
)
from r3jax.planning.robot.travel import cells_for_ball, segment_is_inside

SIZE = 0.25
LATTICE = Lattice((1.0, -2.0, 0.5), (9, 11, 8), SIZE, (5, 5, 5), 2.0)
BALL = Clearance(0.3)
ENDLESS = np.array([[-np.inf] * 3, [np.inf] * 3])
NO_TRAIL = np.zeros((0, 3), np.int64)
TILES = [(x, y, z) for x in (-1, 0, 1) for y in (0, 1) for z in (0, 1)]
FIRST = np.array([-1, 0, 0]) * np.array(LATTICE.cells)
SHAPE = tuple(np.array([3, 2, 2]) * np.array(LATTICE.cells))


def by_tile(cells):
    """Cuts the cells [X, Y, Z] of all tiles, the first one at `FIRST`."""
    found = {}
    for tile in TILES:
        low = np.array(tile) * np.array(LATTICE.cells) - FIRST
        found[tile] = cells[tuple(slice(a, a + n) for a, n in zip(low, LATTICE.cells, strict=True))]
    return found


def coarse_of(cells, trail=NO_TRAIL, clearance=BALL):
    return refreshed(Coarse(LATTICE), by_tile(cells), trail, clearance, ENDLESS)


def a_maze(seed, share=0.03):
    """Cells of all tiles: free, with some matter and some unknown ones."""
    rng = np.random.default_rng(seed)
    cells = np.full(SHAPE, FREE, np.uint8)
    cells[rng.random(SHAPE) < share] = OCCUPIED
    cells[rng.random(SHAPE) < share / 3] = 0
    for _ in range(rng.integers(0, 6)):
        axis = rng.integers(3)
        wall = [slice(None)] * 3
        wall[axis] = int(rng.integers(SHAPE[axis]))
        hole = [slice(a, a + 4) for a in rng.integers(0, np.maximum(1, np.array(SHAPE) - 4))]
        hole[axis] = slice(None)
        is_wall = np.zeros(SHAPE, bool)
        is_wall[tuple(wall)] = True
        is_wall[tuple(hole)] = False
        cells[is_wall] = OCCUPIED
    return cells


def open_cells(cells, trail=NO_TRAIL, clearance=BALL):
    """The open cells by the definition, from all cells at once."""
    is_open = np.zeros(SHAPE, bool)
    if not clearance.only_trail:
        low = LATTICE.origin[2] + FIRST[2] * SIZE - 1e-3 * SIZE
        is_open = cells_for_ball((cells & FREE) > 0, (cells & OCCUPIED) > 0, low, SIZE,
                                 *clearance[:3])  # fmt: skip
    at = tuple((trail - FIRST).T)
    is_open[at] |= cells[at] != OCCUPIED
    return is_open


def pick(rng, is_open):
    return rng.choice(np.argwhere(is_open)) + FIRST


CLEARANCES = [
    BALL,
    Clearance(0.0),
    Clearance(0.3, (1.2, 3.0), 0.6),
    Clearance(0.3, only_trail=True),
]


@settings(max_examples=40)
@given(st.integers(0, 10_000), st.floats(0.0, 0.06), st.sampled_from(CLEARANCES))
def test_a_path_over_tiles_exists_where_one_over_cells_does_and_is_no_shorter(seed, share, clear):
    cells, rng = a_maze(seed, share), np.random.default_rng(seed)
    trail = rng.integers(0, SHAPE, (20, 3))
    trail = np.concatenate([np.stack([np.full(20, a), np.full(20, b), np.arange(5, 25)], axis=1)
                            for a, b, _ in trail])  # fmt: skip
    trail = np.unique(trail[trail[:, 2] < SHAPE[2]], axis=0) + FIRST
    is_open = open_cells(cells, trail, clear)
    coarse = coarse_of(cells, trail, clear)
    shown = coarse.window(FIRST, FIRST + SHAPE)
    np.testing.assert_array_equal(shown[0], is_open)
    np.testing.assert_array_equal(shown[1], (cells & FREE) > 0)
    assume(is_open.any())
    start = pick(rng, is_open)
    fine, _ = shortest_paths(is_open, tuple(int(i) for i in start - FIRST))
    lengths = lengths_from(coarse, start)
    places = np.argwhere(is_open)
    node, steps = coarse.nodes(places + FIRST)
    found = lengths.cost[node] + steps
    fine = fine[tuple(places.T)]
    np.testing.assert_array_equal(np.isfinite(found), np.isfinite(fine))
    reached = np.isfinite(fine)
    assert np.all(found[reached] >= fine[reached] - 1e-3)
    assert not len(lengths.cost) or (coarse.nodes(np.argwhere(~is_open) + FIRST)[0] < 0).all()


@settings(max_examples=20)
@given(st.integers(0, 10_000))
def test_the_path_that_is_followed_lies_in_open_cells_and_is_no_longer(seed):
    cells, rng = a_maze(seed), np.random.default_rng(seed)
    is_open = open_cells(cells)
    assume(is_open.sum() > 100)
    coarse = coarse_of(cells)
    start = pick(rng, is_open)
    lengths = lengths_from(coarse, start)
    jitter = rng.uniform(0.05, 0.95, (2, 3))
    goals = np.argwhere(is_open) + FIRST
    node, steps = coarse.nodes(goals)
    goals = goals[np.isfinite(lengths.cost[node])]
    goal = rng.choice(goals)
    here, there = (np.array(LATTICE.origin) + (c + j) * SIZE
                   for c, j in zip((start, goal), jitter, strict=True))  # fmt: skip
    path = path_along(coarse, lengths, here, there)
    np.testing.assert_array_equal(path[[0, -1]], [here, there])
    scaled = (path - np.array(LATTICE.origin)) / SIZE - FIRST
    for a, b in itertools.pairwise(scaled):
        assert segment_is_inside(is_open, a, b)
    (node,), (steps,) = coarse.nodes(goal[None])
    bound = (lengths.cost[node] + steps) * SIZE + 2 * np.sqrt(3) * SIZE
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).sum() <= bound + 1e-6


def test_in_rooms_a_path_is_at_most_sqrt_2_times_as_long_but_for_its_ends():
    """Rooms with doors, on a level. A coarse cell has up to 9 + 6 + 8 steps."""
    cells = np.full(SHAPE, OCCUPIED, np.uint8)
    cells[1:-1, 1:-1, 1:-1] = FREE
    cells[12, :, :], cells[:, 9, :] = OCCUPIED, OCCUPIED
    cells[12, 3:8, 1:-1], cells[12, 13:18, 1:-1], cells[4:9, 9, 1:-1] = FREE, FREE, FREE
    is_open, coarse = open_cells(cells), coarse_of(cells)
    level = np.zeros_like(is_open)
    level[:, :, 8] = is_open[:, :, 8]
    rng = np.random.default_rng(1)
    for _ in range(20):
        start = pick(rng, level)
        fine, _ = shortest_paths(is_open, tuple(int(i) for i in start - FIRST))
        places = np.argwhere(level)
        node, steps = coarse.nodes(places + FIRST)
        found = lengths_from(coarse, start).cost[node] + steps
        assert np.all(found <= np.sqrt(2) * fine[tuple(places.T)] + 30)


@pytest.mark.parametrize("height", [1.2, 1.4, 1.6, 0.9, 1.31])
def test_a_camera_at_a_fixed_height_has_paths_also_on_a_border_of_layers(height):
    """Cells of 0.2 m whose borders are no binary fractions."""
    lattice = Lattice((0.0, 0.0, -0.2), (10, 10, 14), 0.2, (5, 5, 1), 2.0)
    now = {(x, 0, 0): np.full(lattice.cells, FREE, np.uint8) for x in range(20)}
    clearance = Clearance(0.3, (height, height))
    coarse = refreshed(Coarse(lattice), now, NO_TRAIL, clearance, ENDLESS)
    here, there = np.array([1.0, 1.0, height]), np.array([39.0, 1.0, height])
    path = path_along(coarse, lengths_from(coarse, cell_of(lattice, here)), here, there)
    np.testing.assert_allclose(path[:, 2], height)
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).sum() < 38.5


@settings(max_examples=15)
@given(st.integers(0, 10_000), st.integers(1, 6))
def test_whatever_changes_the_level_is_as_if_built_at_once(seed, num):
    """Changes of cells, trails and closed columns; tiles are given only where they may change."""
    rng = np.random.default_rng(seed)
    cells, coarse = a_maze(seed), Coarse(LATTICE)
    clearance = CLEARANCES[rng.integers(len(CLEARANCES))]
    coarse = refreshed(coarse, by_tile(cells), NO_TRAIL, clearance, ENDLESS)
    trail, closed = NO_TRAIL, np.zeros((0, 2), np.int64)
    for _ in range(num):
        tile = TILES[rng.integers(len(TILES))]
        low = np.array(tile) * np.array(LATTICE.cells) - FIRST
        at = low + rng.integers(0, LATTICE.cells)
        cells = cells.copy()
        cells[tuple(at)] = rng.choice([0, FREE, OCCUPIED, GIVEN_UP])
        if rng.random() < 0.3:
            trail = np.concatenate([trail, [low + rng.integers(0, LATTICE.cells) + FIRST]])
        if rng.random() < 0.3:
            closed = np.array([low[:2] + rng.integers(0, LATTICE.cells[:2]) + FIRST[:2]])
            coarse = with_closed(coarse, closed)
        every = by_tile(cells)
        now = {t: every[t] for t in TILES if t == tile or t not in coarse.tiles}
        coarse = refreshed(coarse, now, trail, clearance, ENDLESS)
    whole = with_closed(Coarse(LATTICE), closed)
    whole = refreshed(whole, by_tile(cells), trail, clearance, ENDLESS)
    assert coarse.tiles.keys() == whole.tiles.keys()
    for tile, part in whole.tiles.items():
        for name in ("cells", "node", "steps", "centers"):
            np.testing.assert_array_equal(getattr(coarse.tiles[tile], name), getattr(part, name))
        for name in ("edges", "goals"):
            for x, y in zip(getattr(coarse.tiles[tile], name), getattr(part, name), strict=True):
                np.testing.assert_array_equal(x, y)
    assert coarse.links.keys() == whole.links.keys()
    for key, edges in whole.links.items():
        for x, y in zip(coarse.links[key], edges, strict=True):
            np.testing.assert_array_equal(x, y)


@settings(max_examples=20)
@given(st.integers(0, 10_000))
def test_goals_are_open_cells_with_a_frontier_in_plain_view(seed):
    cells = a_maze(seed, 0.01)
    cells[-8:] = 0
    coarse = coarse_of(cells)
    is_open, goals = open_cells(cells), coarse.goals
    unknown = np.pad(cells == 0, 1, constant_values=True)
    beside = np.zeros(SHAPE, bool)
    for axis in range(3):
        for side in (0, 2):
            part = [slice(1, -1)] * 3
            part[axis] = slice(side, side + SHAPE[axis])
            beside |= unknown[tuple(part)]
    assert len(goals.place) > 0
    for place, aim, count in zip(goals.place - FIRST, goals.aim - FIRST, goals.num, strict=True):
        assert is_open[tuple(place)]
        assert (cells[tuple(aim)] & FREE) and beside[tuple(aim)]  # noqa: PT018
        assert count >= 4
        assert segment_is_inside((cells & FREE) > 0, aim + 0.5, place + 0.5)


def test_cells_given_up_and_those_beyond_the_box_are_no_frontier():
    cells = np.full(SHAPE, FREE, np.uint8)
    cells[-8:] = GIVEN_UP
    box = np.array([LATTICE.origin + FIRST * SIZE, LATTICE.origin + (FIRST + SHAPE) * SIZE])
    box += [[SIZE], [-SIZE]]
    level = lambda now: refreshed(Coarse(LATTICE), by_tile(now), NO_TRAIL, BALL, box)
    assert len(level(cells).goals.place) == 0
    assert len(level(np.where(cells == GIVEN_UP, 0, cells)).goals.place) > 0


def test_known_cells_are_given_up_when_they_were_looked_at_in_vain_or_viewed():
    log_odds, looks = np.array([[[-2.0, 0.0, 2.0, 0.0, -2.0]]]), np.array([[[3, 3, 0, 2, 0]]])
    viewed = np.array([[[False, False, False, False, True]]])
    cells = known_cells(log_odds, looks, viewed)
    assert cells.tolist() == [[[FREE, GIVEN_UP, OCCUPIED, 0, FREE | GIVEN_UP]]]


def test_a_wall_through_the_block_parts_what_only_a_path_round_it_joins():
    cells = np.full(SHAPE, FREE, np.uint8)
    cells[:18, 11] = OCCUPIED  # up to the last tile
    coarse = coarse_of(cells)
    start, others = np.array([4, 5, 6]) + FIRST, np.array([[4, 17, 6], [8, 6, 6]]) + FIRST
    near = [tile for tile in TILES if tile[0] < 1]
    assert connected_within(coarse, near, start, others).tolist() == [False, True]
    assert connected_within(coarse, TILES, start, others).tolist() == [True, True]


@pytest.mark.parametrize("outside", [[99, 0, 0], [0, 0, -30]])
def test_a_robot_out_of_all_known_cells_has_no_paths(outside):
    coarse = coarse_of(np.full(SHAPE, FREE, np.uint8))
    assert lengths_from(coarse, np.array(outside)) is None
