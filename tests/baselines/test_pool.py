"""The pool of lattice candidates, by hand and as laws over random histories."""

import functools

import jax
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from r3jax.baselines import active_gamer
from r3jax.planning.robot.travel import plan_travel
from tests.planning.rooms import CELL, center, grid_of, two_rooms

NUM = 30
SHAPE = (25, 14, 10)


def travel_in(free, cell=(6, 6, 4)):
    return plan_travel(grid_of(free), center(*cell))


@functools.cache
def rooms_travel(num_known: int = 25):
    """The flat, known up to a cell along x."""
    return travel_in(two_rooms()[0] & (np.arange(25) < num_known)[:, None, None])


def test_columns() -> None:
    """1 m apart from 0.5 m on: cells 2, 7, 12, ... of 0.2 m; 0.5 m apart from 0.25 m on."""
    coarse, fine = active_gamer.STAGES
    columns = coarse.columns(SHAPE, CELL)
    assert sorted(set(columns[:, 0])) == [2, 7, 12, 17, 22]
    assert sorted(set(columns[:, 1])) == [2, 7, 12]
    assert len(columns) == 15
    columns = fine.columns(SHAPE, CELL)
    assert sorted(set(columns[:, 0])) == [1, 3, 6, 8, 11, 13, 16, 18, 21, 23]
    assert len(np.unique(columns, axis=0)) == len(columns) == 60
    assert (coarse.heights, coarse.num_directions) == ((1.75,), 5)
    assert (fine.heights, fine.num_directions) == ((1.0, 2.5), 15)


def test_places() -> None:
    """By hand: free layers 1..8, so the floor is under layer 1 and stops are layers 2..7.

    Their centers lie 0.3, 0.5, ..., 1.3 m above the floor. 1.75 m takes layer 7 (0.45 m below
    it); 1.0 m takes layer 5 (0.9 m: as near as 1.1 m, and lower); 2.5 m is too far from all.
    """
    coarse, fine = active_gamer.STAGES
    travel = rooms_travel()
    cells, there = coarse.places(travel)
    stops = {(2, 7), (7, 2), (7, 7), (17, 2), (17, 7), (22, 2), (22, 7), (2, 2), (12, 7)}
    in_door = {(12, 7)}  # the door's safe cells end at layer 6 (1.1 m): too low for 1.75 m
    found = {(int(x), int(y)) for x, y, _ in cells[there]}
    assert found == stops - in_door
    assert set(cells[there, 2].tolist()) == {7}
    cells, there = fine.places(travel)
    low, high = there.reshape(-1, 2).T
    assert not high.any()
    assert low.sum() == np.sum((travel.goals & travel.safe)[..., 5][tuple(cells[::2, :2].T)])
    assert set(cells[there, 2].tolist()) == {5}


def test_floor() -> None:
    """100 cells of layer 3 and 100 of layer 6; one cell below is an outlier, ten are a floor."""
    floor_layer = active_gamer.floor_layer
    free = np.zeros((10, 10, 8), bool)
    assert floor_layer(free) == 0
    free[:, :, [3, 6]] = True
    assert floor_layer(free) == 3
    free[0, 0, 1] = True
    assert floor_layer(free) == 3
    free[0, :, 1] = True
    assert floor_layer(free) == 1


def test_levels_share_no_cell() -> None:
    """Stops are 0.3, 0.5, ... m high: without a border both levels would take the first."""
    stage = active_gamer.LatticeStage(0.5, (0.3, 0.35), 3)
    cells, there = stage.places(rooms_travel())
    assert there.sum() > 50
    assert len(np.unique(cells[there], axis=0)) == there.sum()


def history(seed: int, num_rounds: int):
    """Rounds of drawing and dismissing while more and more of the flat becomes known."""
    pool = active_gamer
    rng = np.random.default_rng(seed)
    pools = active_gamer.empty_pools(SHAPE, CELL)
    for _ in range(num_rounds):
        travel = rooms_travel(int(rng.integers(9, 26)))  # grows and shrinks
        pools, draw = pool.draw_candidates(pools, travel, NUM)
        if draw is None:
            continue
        gain = np.where(
            rng.random(draw.candidates.num_valid) < 0.7,
            0.001,
            rng.random(draw.candidates.num_valid),
        )
        best = int(rng.integers(len(gain)))
        yield draw, gain, best, travel, pools
        of_stage = list(pools.of_stage)
        of_stage[draw.stage] = pool.dismiss(of_stage[draw.stage], draw, gain, best)
        pools = pool.Pools(tuple(of_stage), pools.num_ended)


def check_history(seed: int, num_rounds: int) -> None:
    """Who left never returns; no candidate twice; all stand where the robot may stop."""
    gone, stage = set(), 0
    for draw, gain, best, travel, pools in history(seed, num_rounds):
        names = [
            (draw.stage, int(p), int(d)) for p, d in zip(draw.place, draw.direction, strict=True)
        ]
        assert 0 < len(names) == len(set(names)) <= NUM
        assert not gone & set(names)
        views = draw.candidates
        rows = np.round(np.concatenate([views.position, views.direction], axis=1), 5)
        assert len(np.unique(rows, axis=0)) == len(names)
        for position, distance in zip(views.position, draw.distance, strict=True):
            cell = travel.cell_of(position)
            assert travel.safe[cell]
            assert travel.reachable[cell]
            np.testing.assert_allclose(np.linalg.norm(position - travel.start), distance)
        gone |= {n for n, g in zip(names, gain, strict=True) if g < 0.005} | {names[best]}
        assert stage <= int(pools.num_ended) <= draw.stage
        stage = int(pools.num_ended)
        for p in pools.of_stage:
            assert not np.any(np.asarray(p.left) & ~np.asarray(p.entered))
    assert gone


def test_order() -> None:
    """Never scored: nearest first. Then the remembered gains decide, whatever the distance."""
    pool, travel = active_gamer, rooms_travel()
    pools, draw = pool.draw_candidates(active_gamer.empty_pools(SHAPE, CELL), travel, 12)
    first = pools.of_stage[0]
    cells, there = pool.STAGES[0].places(travel)
    every = np.linalg.norm(travel.centers(cells[there]) - travel.start, axis=1)
    np.testing.assert_allclose(draw.distance, np.sort(np.repeat(every, 5))[:12])
    # All but the two farthest places were scored; now these come first, then the best of the rest.
    gain = np.random.default_rng(1).uniform(0.01, 0.9, first.gain.shape).astype(np.float32)
    farthest = np.argsort(
        np.where(there, np.linalg.norm(travel.centers(cells) - travel.start, axis=1), -1)
    )[-2:]
    gain[farthest] = 1.0
    memory = pool.Pools((pool.Pool(first.entered, first.left, gain), pools.of_stage[1]), 0)
    _, draw = pool.draw_candidates(memory, travel, 12)
    assert set(draw.place[:10].tolist()) == set(farthest.tolist())
    rest = np.sort(gain[np.asarray(first.entered) & (gain < 1)])[::-1]
    np.testing.assert_array_equal(gain[draw.place[10:], draw.direction[10:]], rest[:2])
    # Dismissing changes the drawn ones only, and remembers what they showed.
    seen = np.array([0.5, 0.00499, 0.00501] + [0.2] * 9)
    after = pool.dismiss(memory.of_stage[0], draw, seen, 0)
    left = np.asarray(after.left)[draw.place, draw.direction]
    assert left.tolist() == [True, True, False] + [False] * 9
    assert np.asarray(after.left).sum() == 2
    np.testing.assert_allclose(np.asarray(after.gain)[draw.place, draw.direction], seen, rtol=1e-6)


def test_stages() -> None:
    """Stage 0 until its pool is spent, for good; what cannot be reached waits meanwhile."""
    pool, free = active_gamer, two_rooms()[0]
    first_room = free & (np.arange(25) < 13)[:, None, None]
    pools, draw = pool.draw_candidates(
        active_gamer.empty_pools(SHAPE, CELL), travel_in(first_room), NUM
    )
    assert draw.stage == 0
    num_before = draw.candidates.num_valid
    assert num_before == 20  # 4 columns, 5 directions
    # Shut in: the pool keeps them, the next stage has its turn where it can be reached.
    shut = first_room & (np.arange(14) < 4)[:, None] & (np.arange(25) > 3)[:, None, None]
    pools, draw = pool.draw_candidates(pools, travel_in(shut & False), NUM)
    assert draw is None
    assert int(pools.num_ended) == 0
    low = first_room & (np.arange(10) < 8)  # stops up to 1.1 m: too low for stage 0
    pools, draw = pool.draw_candidates(pools, travel_in(low), NUM)
    assert (draw.stage, int(pools.num_ended)) == (1, 0)
    pools, draw = pool.draw_candidates(pools, travel_in(first_room), NUM)
    assert (draw.stage, draw.candidates.num_valid) == (0, num_before)
    spent = pool.dismiss(pools.of_stage[0], draw, np.zeros(num_before), 0)
    pools = pool.Pools((spent, pools.of_stage[1]), pools.num_ended)
    # New free space keeps the stage open; without it, it has ended, and stays so.
    assert pool.draw_candidates(pools, travel_in(free), NUM)[1].stage == 0
    pools, draw = pool.draw_candidates(pools, travel_in(first_room), NUM)
    assert (draw.stage, int(pools.num_ended)) == (1, 1)
    pools, draw = pool.draw_candidates(pools, travel_in(free), NUM)
    assert draw.stage == 1
    for _ in range(200):
        if draw is None:
            break
        worthless = pool.dismiss(pools.of_stage[1], draw, np.zeros(draw.candidates.num_valid), 0)
        pools = pool.Pools((pools.of_stage[0], worthless), pools.num_ended)
        pools, draw = pool.draw_candidates(pools, travel_in(free), NUM)
    assert draw is None
    assert int(pools.num_ended) == 2


@given(st.integers(0, 1000))
def test_no_candidate_returns(seed):
    check_history(seed, num_rounds=6)


def test_no_candidate_returns_in_the_long_run():
    check_history(5, num_rounds=25)


def test_the_pool_is_a_pytree_of_arrays():
    leaves = jax.tree.leaves(active_gamer.empty_pools(SHAPE, CELL))
    assert all(isinstance(leaf, jax.Array) for leaf in leaves)
    assert {leaf.shape for leaf in leaves} == {(15, 5), (120, 15), ()}
