"""Planners of places without end: what is at hand, ways to what is not, and views left there."""

import functools
import itertools
import re
import threading
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import r3jax
from r3jax.errors import InputError, PathError
from r3jax.exploration.state import compilations
from r3jax.mapping import tiles as tiles_module
from r3jax.mapping.occupancy import COSTMAP, KEEP_OUT, TRUSTED
from r3jax.mapping.tiles import packed_layer, page, unpacked_layer, whole_map
from r3jax.mapping.update import integrate_growing
from r3jax.planning import far as far_module
from r3jax.planning.columns import pixel_columns, polygon_columns
from r3jax.planning.far import (
    Views,
    arrived,
    far_arrays,
    far_of,
    first_far,
    weigh_far,
    with_coarse,
    with_columns,
    with_views,
)
from r3jax.planning.far_paths import Coarse, coarse_arrays
from r3jax.planning.planner import at_hand, decide_ahead, first_map, reconsider
from r3jax.planning.policy import Decision
from r3jax.planning.turning import count_look
from tests.mapping.test_tiles import assert_same_map
from tests.rooms_of_boxes import frame_in_room, pose_at

CAMERA = r3jax.Camera.from_fov(48, 36, 75.0)
CONFIG = r3jax.MappingConfig(voxel_size=0.1, cell_size=0.25, max_range=3.0)
HALL = np.array([[0.0, 0.0, 0.0], [30.0, 4.0, 2.6]])
ENDLESS = np.array([[-np.inf] * 3, [np.inf] * 3])
KEY = jax.random.key(3)
ENDS = np.array([[0.5, 0.5, 0.5], [50.0, 0.5, 0.5]])


def a_policy(name="r3-pano", **settings):
    scoring = r3jax.ScoringConfig(max_range=3.0)
    return r3jax.make_policy(name, scoring=scoring, num_candidates=12, num_frontier=6, **settings)


def far_at(position, box=ENDLESS):
    pose = np.eye(4)
    pose[:3, 3] = position
    return first_far(CONFIG, a_policy(), CAMERA, box, [pose])


def way(*corners):
    """Cells along lines between corners, each a neighbor of the next."""
    cells = [np.array(corners[0])[None]]
    for a, b in itertools.pairwise(corners):
        steps = np.linspace(a, b, int(np.abs(np.subtract(b, a)).max()) + 1)
        cells.append(np.round(steps[1:]).astype(np.int64))
    return np.concatenate(cells)


def known(far, free):
    """The same with free cells [n, 3], all of them far away, and matter around."""
    cells, around = {}, np.array(list(itertools.product((-1, 0, 1), repeat=3)))
    lattice = far.tiles.lattice
    for values, found in ((3.0, free[:, None] + around), (-3.0, free)):
        for cell in np.reshape(found, (-1, 3)).astype(int):
            tile, local = np.divmod(cell, lattice.cells)
            odds = cells.setdefault(tuple(tile.tolist()), np.zeros(lattice.cells, np.float32))
            odds[tuple(local)] = values
    packed = {tile: {"log_odds": packed_layer(odds)} for tile, odds in cells.items()}
    return updated(replace(far, tiles=replace(far.tiles, cells=packed)))


def updated(far, log_odds=None, policy=None):
    """The same with an up-to-date coarse level; of the block nothing is known, unless given."""
    policy = policy or a_policy()
    if log_odds is None:
        log_odds = np.zeros(far.tiles.lattice.shape, np.float32)
    grid = far.grid(log_odds)
    memory = policy.init(CAMERA, grid, key=KEY)
    return with_coarse(far, grid, memory, policy.config)


def on_trail(far, cells):
    """A robot far away from the block that has come through known cells [n, 3]."""
    far = replace(far, tiles=replace(far.tiles, middle=(0, 0, 9)), trails=cells)
    return known(far, cells)


def a_view(position, place, path, utility):
    pose = np.eye(4)[None].copy()
    pose[0, :3, 3] = position
    return Views(pose, np.array([place], float), np.array([path]), {"utility": np.array([utility])})


def test_a_view_left_far_away_is_gone_back_to_over_the_way_that_was_come():
    """Round a corner: 200 cells out, 100 to the side; nothing is left here."""
    far = on_trail(far_at([0.1, 0.1, 0.1]), way((0, 0, 0), (200, 0, 0), (200, 100, 0)))
    place = (np.array([200, 100, 0]) + 0.5) * 0.25
    far = replace(far, views=a_view(place + np.array([0.0, 2.0, 0.0]), place, 2.0, 50.0))
    here = np.eye(4)
    here[:3, 3] = 0.125
    decision, after = weigh_far(far, a_policy(), None, here)
    assert decision is not None
    np.testing.assert_allclose(decision.waypoints[0], here[:3, 3])
    np.testing.assert_allclose(decision.waypoints[-1], place)
    np.testing.assert_allclose(decision.T_world_camera[:3, 3], place)
    assert decision.length == pytest.approx(300 * 0.25, rel=0.02)  # the corner is cut by one cell
    assert len(decision.waypoints) <= 5
    there = arrived(after, place)
    assert len(after.views.path) == 1
    assert len(there.views.path) == 0  # a promise is taken once


@pytest.mark.parametrize("kind", ["zone", "costmap", "refused"])
def test_no_path_leads_through_what_was_closed_since(kind):
    far = on_trail(far_at([0.1, 0.1, 0.1]), way((0, 0, 0), (200, 0, 0)))
    place = np.array([200.5, 0.5, 0.5]) * 0.25
    far = replace(far, views=a_view(place, place, 0.0, 50.0))
    here = np.eye(4)
    here[:3, 3] = 0.125
    assert weigh_far(far, a_policy(), None, here)[0] is not None
    corners = np.array([[20.0, -1.0], [21.0, -1.0], [21.0, 1.0], [20.0, 1.0]])
    if kind == "refused":
        far = replace(far, refused=np.array([[*place, 0.5]]))
    elif kind == "zone":
        far = with_columns(far, {KEEP_OUT: polygon_columns(far.plane, corners)})
    else:
        far = with_columns(far, {COSTMAP: pixel_columns(far.plane, np.array([[20.0, 0.0]]), 0.3)})
    after = updated(far)
    assert weigh_far(after, a_policy(), None, here)[0] is None


def test_a_view_without_a_way_is_no_goal():
    cells = np.concatenate([way((0, 0, 0), (9, 0, 0)), way((100, 0, 0), (200, 0, 0))])
    far = on_trail(far_at([0.1, 0.1, 0.1]), cells)
    place = np.array([200.5, 0.5, 0.5]) * 0.25
    far = replace(far, views=a_view(place, place, 0.0, 50.0))
    here = np.eye(4)
    here[:3, 3] = 0.125
    assert weigh_far(far, a_policy(), None, here) == (None, far)


@pytest.mark.parametrize(("promise", "goes"), [(5.0, False), (500.0, True)])
def test_near_and_far_views_are_weighed_together(promise, goes):
    far = on_trail(far_at([0.1, 0.1, 0.1]), way((0, 0, 0), (80, 0, 0)))
    place = np.array([80.5, 0.5, 0.5]) * 0.25
    far = replace(far, views=a_view(place, place, 0.0, promise))
    near = Decision(
        np.eye(4), np.zeros((2, 3)), 1.0, 0.5, np.tile(np.eye(4), (2, 1, 1)),
        {"utility": np.array([40.0, 30.0]), "path": np.array([1.0, 2.0]),
         "total": np.array([0.5, 0.4])},
    )  # fmt: skip
    here = np.eye(4)
    here[:3, 3] = 0.125
    decision, _ = weigh_far(far, a_policy(), near, here)
    assert (decision is not near) is goes
    if goes:
        assert len(decision.candidates) == len(decision.utilities["total"]) == 3
        assert decision.score == decision.utilities["total"].max()


def test_of_views_close_together_the_newest_best_is_kept():
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :3, 3] = [[3.1, 0.1, 0.1], [3.2, 0.2, 0.2], [5.1, 0.1, 0.1], [0.2, 0.0, 0.0]]
    utilities = {
        "utility": np.array([1.0, 4.0, 2.0, 9.0]),
        "path": np.array([3.0, 3.0, np.inf, 0.1]),
    }
    decision = Decision(np.eye(4), np.zeros((1, 3)), 0.0, 0.0, poses,
                        utilities | {"total": np.zeros(4)})  # fmt: skip
    far = replace(far_at([0.0, 0.0, 0.0]), views=a_view([3.3, 0.3, 0.3], [0, 0, 0], 9.0, 99.0))
    kept = with_views(far, decision, np.zeros(3), 0.5).views
    assert kept.values["utility"].tolist() == [4.0]


def test_a_robot_that_was_carried_a_step_is_still_on_its_way():
    far = replace(far_at([0.1, 0.1, 0.1]), trails=way((0, 0, 0), (4, 0, 0)))
    near = arrived(far, np.array([1.6, 0.1, 0.1]))
    assert len(near.trails) > len(far.trails)
    gaps = np.linalg.norm(near.trails[:, None] - near.trails[None], axis=2)
    assert np.sort(gaps, axis=1)[:, 1].max() < 1.8  # every cell has a neighbor
    assert len(arrived(far, np.array([50.0, 0.1, 0.1])).trails) == len(far.trails) + 1


def test_limits_zones_and_refusals_are_drawn_into_every_block():
    box = np.array([[-20.0, -np.inf, 0.0], [9.0, np.inf, 2.0]])
    far = far_at([0.0, 0.0, 1.0], box)
    lattice = far.tiles.lattice
    assert lattice.num == (5, 5, 1)
    zone = np.array([[6.0, 1.0], [7.0, 1.0], [7.0, 2.0], [6.0, 2.0]])
    far = with_columns(far, {KEEP_OUT: polygon_columns(far.plane, zone)})
    far = replace(far, refused=np.array([[5.0, 0.0, 1.0, 0.6]]))
    for middle in ((1, 0, 0), (2, 0, 0)):
        moved = replace(far, tiles=replace(far.tiles, middle=middle))
        grid = moved.grid(np.zeros(lattice.shape, np.float32))
        cell = lambda p, g=grid: tuple(np.asarray(r3jax.mapping.occupancy.world_to_cell(
            g, jnp.asarray([p], jnp.float32)))[0].tolist())  # fmt: skip
        assert grid.explorable[cell([8.5, 0.0, 1.0])]
        assert not grid.explorable[cell([9.6, 0.0, 1.0])]
        assert grid.closed[cell([6.5, 1.5, 1.0])]
        assert grid.refused[cell([5.0, 0.0, 1.0])]
        assert not grid.refused[cell([4.2, 0.0, 1.0])]
        corner = lattice.corner(middle)
        assert grid.refused[cell([*(corner[:2] + 0.3), 1.0])]


def test_other_policies_and_positions_are_refused():
    for name in ("active-gs", "random"):
        with pytest.raises(InputError, match=name):
            r3jax.start(CAMERA, policy=name)
    with pytest.raises(InputError, match="bounds"):
        r3jax.start(CAMERA, np.array([[0.0, 0.0, np.nan], [1.0, 1.0, 1.0]]))
    planner = r3jax.start(CAMERA, policy=a_policy(), config=CONFIG)
    with pytest.raises(InputError, match="subtract an origin"):
        at_hand(planner, np.array([500_000.0, 5_600_000.0, 100.0]))  # UTM
    with pytest.raises(InputError, match=r"tile_folder.*bounds"):
        r3jax.start(CAMERA, HALL, a_policy(), tile_folder="unused")


def a_box(low, high):
    """All cells from one to another, [n, 3]."""
    ranges = (np.arange(a, b + 1) for a, b in zip(low, high, strict=True))
    return np.stack(np.meshgrid(*ranges, indexing="ij"), axis=-1).reshape(-1, 3)


def at_cell(*cell):
    pose = np.eye(4)
    pose[:3, 3] = (np.array(cell) + 0.5) * 0.25
    return pose


def test_a_frontier_far_away_is_a_goal_though_no_view_of_it_was_scored():
    """A corridor whose far end is not known."""
    far = replace(far_at([0.1, 0.1, 0.1]), trails=np.array([[2, 2, 2]]))
    far = replace(far, tiles=replace(far.tiles, middle=(0, 0, 9)))
    free = a_box((0, 0, 0), (200, 4, 4))
    far = known(far, np.concatenate([free, a_box((201, -1, -1), (202, 5, 5))]))
    cells = {tile: dict(layers) for tile, layers in far.tiles.cells.items()}
    (tile, local), size = np.divmod([201, 2, 2], far.tiles.lattice.cells), far.tiles.lattice.cells
    odds = np.array(unpacked_layer(cells[tuple(tile)]["log_odds"], size))
    odds[local[0] :] = 0.0
    cells[tuple(tile.tolist())] = {"log_odds": packed_layer(odds)}
    cells = {t: x for t, x in cells.items() if t[0] <= tile[0]}
    far = replace(far, tiles=replace(far.tiles, cells=cells), coarse=Coarse(far.tiles.lattice))
    far = updated(far)
    here = at_cell(2, 2, 2)
    decision, after = weigh_far(far, a_policy(), None, here)
    assert decision is not None
    end = decision.waypoints[-1]
    assert 201 * 0.25 - 2.5 < end[0] < 201 * 0.25
    assert decision.length == pytest.approx(np.linalg.norm(end - here[:3, 3]), rel=0.05)
    assert weigh_far(arrived(after, end), a_policy(), None, here)[0] is None  # it is tried once


def in_a_corridor(policy, viewed=None):
    """A planner in a corridor of 50 m, neither end of which is known, and where the robot is."""
    planner = r3jax.start(CAMERA, policy=policy, config=CONFIG, starts=[at_cell(4, 2, 2)])
    far = replace(planner.far, tiles=replace(planner.far.tiles, middle=(0, 0, 9)))
    free = a_box((0, 0, 0), (200, 4, 4))
    far = known(far, free)
    cells = {tile: dict(layers) for tile, layers in far.tiles.cells.items()}
    for x in (-1, 201):
        for cell in a_box((x, -1, -1), (x, 5, 5)):
            tile, local = np.divmod(cell, far.tiles.lattice.cells)
            layer = cells[tuple(tile.tolist())]
            odds = np.array(unpacked_layer(layer["log_odds"], far.tiles.lattice.cells))
            odds[tuple(local)] = 0.0
            layer["log_odds"] = packed_layer(odds)
    tiles = replace(far.tiles, cells=cells)
    far = updated(replace(far, tiles=tiles, coarse=Coarse(far.tiles.lattice)))
    here = at_cell(4, 2, 2)
    grid = far.grid(np.zeros(far.tiles.lattice.shape, np.float32))
    planner = at_hand(replace(planner, far=far, grid=grid), here[:3, 3])
    planner = replace(planner, far=planner.far.settled)  # what tests replace stays
    memory = None if viewed is None else np.full(planner.grid.log_odds.shape, viewed)
    return replace(planner, policy_state=replace(planner.policy_state, memory=memory)), here


def test_frontier_views_cells_far_away_before_it_starts_over_with_those_at_hand():
    planner, here = in_a_corridor(a_policy("frontier"), viewed=False)
    first, _, _ = r3jax.decide(planner, here, KEY)
    assert first.length < 3.0
    planner, here = in_a_corridor(a_policy("frontier"), viewed=True)
    decision, after, _ = r3jax.decide(planner, here, KEY)
    assert decision.T_world_camera[0, 3] > 45.0
    np.testing.assert_array_equal(after.policy_state.memory, True)
    tried = replace(after.far, tried=decision.waypoints[-1:], goal=after.far.goal[:0])
    again, after, _ = r3jax.decide(replace(planner, far=tried), here, KEY)
    assert again.length < 3.0
    assert not after.policy_state.memory.all()


@pytest.mark.parametrize("name", ["r3", "r3-pano", "r3-ahead"])
def test_a_far_goal_wins_on_arrival_where_it_would_win_in_a_decision(name):
    """Nothing has moved since the views at hand were scored."""
    planner, here = in_a_corridor(a_policy(name))
    at_hand_only = (planner.policy_state, planner.map_state, planner.grid, here)
    planned, _, _ = planner.policy.decide(*at_hand_only, key=KEY)
    best, goes = planned.utilities["utility"].max(), []
    place = at_cell(190, 2, 2)[:3, 3]
    for promise in np.geomspace(0.01, 1e4, 5) * best:
        far = replace(planner.far, views=a_view(place, place, 0.0, promise), tried=ENDS)
        with_view = replace(planner, far=far)
        decided, after, _ = r3jax.decide(with_view, here, KEY)
        again, later, _ = reconsider(with_view, here, planned, KEY)
        goes.append(decided.T_world_camera[0, 3] > 40.0)
        assert (again.T_world_camera[0, 3] > 40.0) == goes[-1]
        np.testing.assert_array_equal(later.far.goal, after.far.goal)
        if goes[-1]:
            np.testing.assert_array_equal(again.waypoints, decided.waypoints)
    assert goes == sorted(goes)
    assert goes[-1] > goes[0]


def test_frontier_marks_what_it_views_when_it_goes_there_not_when_it_plans_to():
    planner, here = in_a_corridor(a_policy("frontier"), viewed=False)
    scoring = planner.policy.config.scoring
    planned, ahead, _ = decide_ahead(planner, CAMERA, here, KEY, scoring)
    assert planned.length < 3.0
    assert not ahead.policy_state.memory.any()
    decision, after, _ = reconsider(planner, here, planned, KEY)
    assert decision.length < 3.0
    assert after.policy_state.memory.any()
    planner, here = in_a_corridor(a_policy("frontier"), viewed=True)
    assert decide_ahead(planner, CAMERA, here, KEY, scoring)[0] is None  # all is viewed here


def test_nothing_is_compiled_when_the_block_moves_and_leaves_views_behind():
    scoring = r3jax.ScoringConfig(max_range=3.0, panorama_bins=150)  # no other test compiles this
    policy = r3jax.make_policy("r3-pano", scoring=scoring, num_candidates=12, num_frontier=6)
    planner, here = in_a_corridor(policy)
    far = replace(planner.far, coarse=Coarse(planner.far.tiles.lattice))
    _, planner, _ = r3jax.decide(replace(planner, far=far), here, KEY)
    # As frames that were captured on the way are counted.
    pose = jnp.asarray(here, dtype=jnp.float32)
    looked = count_look(
        planner.policy_state, planner.map_state, planner.grid, CAMERA, pose, scoring
    )
    planner = replace(planner, policy_state=looked)
    left = a_view([0.1, 0.6, 0.6], here[:3, 3], 1.0, 5.0)
    before = compilations.count
    away = at_hand(
        replace(planner, far=replace(planner.far, views=left)), here[:3, 3] + [4.0, 0, 0]
    )
    views = away.far.settled.views
    assert compilations.count == before > 0
    assert views.values["utility"][0] not in (0.0, 5.0)  # scored once more


def test_a_frame_does_not_wait_for_what_the_block_leaves_behind(monkeypatch):
    planner, here = in_a_corridor(a_policy())
    left = a_view([0.1, 0.6, 0.6], here[:3, 3], 1.0, 5.0)
    planner = replace(planner, far=replace(planner.far, views=left))
    there, may_score, score = here[:3, 3] + [4.0, 0, 0], threading.Event(), far_module._renewed
    at_once = at_hand(planner, there)
    expected = at_once.far.settled

    def held(*arguments):
        assert may_score.wait(60.0)
        return score(*arguments)

    monkeypatch.setattr(far_module, "_renewed", held)
    moved = at_hand(planner, there)
    again = at_hand(
        moved, there + np.array([4.0, 0.0, 0.0])
    )  # a second block, while the first is not scored
    np.testing.assert_array_equal(moved.map_state.key, at_once.map_state.key)
    assert not moved.far.left.done()
    assert not again.far.left.done()
    may_score.set()
    np.testing.assert_array_equal(moved.far.settled.views.pose, expected.views.pose)
    for name, values in moved.far.settled.views.values.items():
        np.testing.assert_array_equal(values, expected.views.values[name])
    assert len(again.far.settled.views.path) >= len(expected.views.path) > 0


def the_ring():
    """Two corridors of 20 m side by side, joined at both ends; the robot came through one."""
    far = replace(far_at([0.1, 0.1, 0.1]), trails=way((2, 2, 2), (2, 22, 2), (82, 22, 2)))
    far = replace(far, tiles=replace(far.tiles, middle=(0, 0, 9)))
    boxes = [((0, 0, 0), (84, 4, 4)), ((0, 20, 0), (84, 24, 4)),
             ((0, 0, 0), (4, 24, 4)), ((80, 0, 0), (84, 24, 4))]  # fmt: skip
    return known(far, np.concatenate([a_box(*box) for box in boxes]))


def test_a_path_takes_a_shortcut_that_was_seen_and_never_traveled():
    far = the_ring()
    place = at_cell(82, 22, 2)[:3, 3]
    far = replace(far, views=a_view(place, place, 0.0, 50.0))
    decision, _ = weigh_far(far, a_policy(), None, at_cell(82, 2, 2))
    assert decision is not None
    assert decision.length == pytest.approx(20 * 0.25, rel=0.1)  # over the trail it is 45 m
    np.testing.assert_allclose(decision.waypoints[-1], place)


def test_a_robot_whose_path_turns_out_blocked_takes_another_to_the_same_goal():
    far, policy = the_ring(), a_policy()
    place = at_cell(2, 22, 2)[:3, 3]
    far = replace(far, views=a_view(place, place, 0.0, 50.0), trails=far.trails[:60])
    first, far = weigh_far(far, policy, None, at_cell(30, 2, 2))
    assert first is not None
    assert first.length < 14.0
    # On its way it has moved on, and sees what has closed the corridor ahead.
    here = at_cell(12, 2, 2)
    state = first_map(CONFIG)
    layers = {"log_odds": np.zeros(far.tiles.lattice.shape, np.float32),
              "looks": np.zeros(far.tiles.lattice.shape, np.int32)}  # fmt: skip
    _, layers, tiles = page(state, layers, far.tiles, here[:3, 3])
    far = replace(far, tiles=tiles)
    odds, low = np.array(layers["log_odds"]), np.array([8, 0, 0]) - far.first_cell
    odds[low[0], low[1] : low[1] + 5, low[2] : low[2] + 5] = 3.0
    far = updated(arrived(far, here[:3, 3]), odds)
    second, _ = weigh_far(far, policy, None, here)
    assert second is not None
    np.testing.assert_allclose(second.waypoints[-1], place)
    assert second.length > 35.0
    assert not np.any(np.all(np.abs(second.waypoints - at_cell(8, 2, 2)[:3, 3]) < 0.6, axis=1))


def test_what_no_path_within_the_block_joins_is_gone_to_round_it():
    """At hand, behind a wall; the end of the wall is not at hand."""
    far = the_ring()
    place = at_cell(2, 22, 2)[:3, 3]
    far = replace(far, views=a_view(place, place, 0.0, 50.0))
    wall = a_box((0, 10, 0), (4, 10, 4))
    here = at_cell(2, 2, 2)
    layers = {"log_odds": np.zeros(far.tiles.lattice.shape, np.float32)}
    _, layers, tiles = page(first_map(CONFIG), layers, far.tiles, here[:3, 3])
    far = replace(far, tiles=tiles, trails=far.trails[:1])
    odds = np.array(layers["log_odds"])
    assert weigh_far(updated(far, odds), a_policy(), None, here)[0] is None
    odds[tuple((wall - far.first_cell).T)] = 3.0
    decision, _ = weigh_far(updated(far, odds), a_policy(), None, here)
    assert decision is not None
    assert decision.length > 35.0


def test_policies_weigh_what_is_far_by_their_own_rules():
    far = {"utility": np.array([80.0]), "path": np.array([4.0])}
    ahead = a_policy("r3-ahead")
    near = {"utility": np.array([9.0]), "ahead": np.array([3.0]), "path": np.array([1.0])}
    assert ahead.weigh_far(near, far).tolist() == [3.0, 80.0 / (4.0 + 4.0)]
    frontier = a_policy("frontier")
    assert frontier.weigh_far({"path": np.array([9.0])}, far).tolist() == [-9.0, -4.0]
    near = {"path": np.array([0.3]), "lot": np.array([0.9])}
    assert frontier.weigh_far(near, far).tolist() == [-np.inf, -4.0]
    assert frontier.weigh_far({}, far).tolist() == [-4.0]


def test_a_mask_closes_the_columns_that_the_grid_has_now():
    planner = r3jax.start(CAMERA, policy=a_policy(), config=CONFIG)
    mask = np.zeros(planner.grid.log_odds.shape[:2], bool)
    mask[7, 9:12] = True
    planner = r3jax.keep_out(planner, mask)
    np.testing.assert_array_equal(np.asarray(planner.grid.closed).any(axis=2), mask)
    place = np.asarray(planner.grid.origin)[:2] + (np.array([7, 10]) + 0.5) * 0.25
    moved = at_hand(planner, np.array([2.0, 0.0, 0.0]))
    cell = np.floor((place - np.asarray(moved.grid.origin)[:2]) / 0.25).astype(int)
    assert np.asarray(moved.grid.closed)[tuple(cell)].all()
    assert np.asarray(moved.grid.closed).any(axis=2).sum() == 3


def test_cells_that_frontier_has_viewed_move_with_the_tiles():
    planner = r3jax.start(CAMERA, policy=a_policy("frontier"), config=CONFIG)
    viewed = np.random.default_rng(0).random(planner.grid.log_odds.shape) < 0.1
    planner = replace(planner, policy_state=replace(planner.policy_state, memory=viewed))
    away = at_hand(planner, np.array([50.0, 9.0, 0.0]))
    assert not away.policy_state.memory.any()
    back = at_hand(away, np.array([0.1, 0.1, 0.1]))
    np.testing.assert_array_equal(back.policy_state.memory, viewed)


@pytest.mark.full
def test_r3_ahead_explores_a_hall_to_its_end_by_tiles():
    name, settings = "r3-ahead", {"beam": 2, "branching": 3, "horizon": 2}
    pose, farthest = pose_at([2.0, 2.0, 1.3], 0.0, 0.0), 0.0
    planner = r3jax.start(CAMERA, policy=a_policy(name, **settings), starts=[pose], config=CONFIG)
    for step in range(30):
        frame = frame_in_room(CAMERA, pose, room=HALL, noise=0.002, seed=step)
        planner = r3jax.observe(
            planner, r3jax.Frame.from_arrays(frame.rgb, frame.depth, pose, CAMERA)
        )
        decision, planner, info = r3jax.decide(planner, pose, jax.random.fold_in(KEY, step))
        assert decision is not None, info.reason
        pose = decision.T_world_camera
        assert np.all(pose[:3, 3] > HALL[0]) and np.all(pose[:3, 3] < HALL[1])  # noqa: PT018
        farthest = max(farthest, pose[0, 3])
    assert farthest > 12.0


def test_a_table_may_begin_larger_and_stays_so():
    pose = pose_at([2.0, 2.0, 1.3], 0.0, 0.0)
    given = replace(CONFIG, capacity=4 * far_at(pose[:3, 3]).tiles.capacity)
    planner = r3jax.start(CAMERA, policy=a_policy(), starts=[pose], config=given)
    planner = r3jax.observe(planner, frame_in_room(CAMERA, pose, room=HALL, noise=0.002, seed=0))
    moved = at_hand(planner, np.array([9.0, 2.0, 1.3]))
    assert moved.far.tiles.middle != planner.far.tiles.middle
    for each in (planner, moved):
        assert each.map_state.capacity == given.capacity


def test_a_table_that_grows_says_how_much_floor_it_holds(monkeypatch):
    monkeypatch.setattr(tiles_module, "VOXELS_PER_AREA", 0.01)
    pose = pose_at([2.0, 2.0, 1.3], 0.0, 0.0)
    box = np.array([[0.0, 0.0, 0.0], [60.0, 60.0, 9.0]])
    config = replace(CONFIG, tiles=True, capacity=1 << 12)
    planner = r3jax.start(CAMERA, box, a_policy(), starts=[pose], config=config)
    assert planner.far.tiles.lattice.num[2] == 1  # as high as its box, and not cut
    frames = [frame_in_room(CAMERA, pose_at(pose[:3, 3], yaw, 0.0), room=HALL)
              for yaw in np.arange(0.0, 360.0, 30.0)]  # fmt: skip
    x, y, _ = np.array(planner.grid.log_odds.shape) * CONFIG.cell_size
    with pytest.warns(UserWarning, match=re.escape(f"the {x:.0f} x {y:.0f} m at hand")):
        functools.reduce(r3jax.observe, frames, planner)


@pytest.mark.full
def test_a_hall_is_explored_to_its_end_by_tiles(tmp_path):
    """No bounds: map and tiles are the map without tiles, and a saved planner goes on alike."""
    pose = pose_at([2.0, 2.0, 1.3], 0.0, 0.0)
    planner = r3jax.start(CAMERA, policy=a_policy(), starts=[pose], config=CONFIG)
    shape, capacity = planner.grid.log_odds.shape, planner.map_state.capacity
    whole, farthest, first = first_map(planner.config), 0.0, planner
    for step in range(30):
        frame = frame_in_room(CAMERA, pose, room=HALL, noise=0.002, seed=step)
        frame = r3jax.Frame.from_arrays(frame.rgb, frame.depth, pose, CAMERA)
        planner = r3jax.observe(planner, frame)
        whole = integrate_growing(whole, frame, CONFIG.max_range)
        decision, planner, info = r3jax.decide(planner, pose, jax.random.fold_in(KEY, step))
        assert decision is not None, info.reason
        np.testing.assert_allclose(decision.waypoints[0], pose[:3, 3])
        np.testing.assert_allclose(decision.waypoints[-1], decision.T_world_camera[:3, 3])
        assert np.all(decision.waypoints > HALL[0]) and np.all(decision.waypoints < HALL[1])  # noqa: PT018
        pose = decision.T_world_camera
        farthest = max(farthest, pose[0, 3])
    assert (planner.grid.log_odds.shape, planner.map_state.capacity) == (shape, capacity)
    assert farthest > 12.0
    assert len(planner.far.tiles.voxels) > 0
    assert_same_map(whole_map(planner.map_state, planner.far.tiles), whole)
    assert len(first.far.tiles.voxels) == 0  # planners share tiles and change none

    r3jax.save(planner, tmp_path / "saved")
    scratch = tmp_path / "scratch"
    again = r3jax.load(tmp_path / "saved", tile_folder=scratch, tile_memory=0)
    assert not again.far.tiles.voxels.memory
    assert_same_map(whole_map(again.map_state, again.far.tiles), whole)
    back = pose_at([2.0, 2.0, 1.3], 180.0, 0.0)
    frame = frame_in_room(CAMERA, back, room=HALL)
    frame = r3jax.Frame.from_arrays(frame.rgb, frame.depth, back, CAMERA)
    ends = [r3jax.decide(r3jax.observe(p, frame), back, KEY)[0] for p in (planner, again)]
    np.testing.assert_array_equal(ends[0].T_world_camera, ends[1].T_world_camera)

    for path in scratch.rglob("*.tile"):
        path.unlink()
    with pytest.raises(PathError, match=r"r3jax\.rebuild"):
        at_hand(again, back[:3, 3])
    rebuilt = r3jax.rebuild(again, [frame])
    assert rebuilt.far.tiles.folder is again.far.tiles.folder
    alone = integrate_growing(first_map(planner.config), frame, CONFIG.max_range)
    assert_same_map(rebuilt.whole_map, alone)


def test_what_is_known_of_far_places_can_be_stored():
    far = replace(far_at([0.0, 0.0, 0.0]), trails=way((0, 0, 0), (4, 0, 0)))
    far = replace(far, views=a_view([3.0, 0.0, 0.0], [0, 0, 0], 3.0, 7.0))
    far = with_columns(far, {KEEP_OUT: np.array([[3, 4], [-5, 6]]), TRUSTED: np.array([[1, 2]])})
    again = far_of(far_arrays(far), CONFIG, CAMERA)
    first, second = far_arrays(far), far_arrays(again)
    assert first.keys() == second.keys()
    for name in first:
        np.testing.assert_array_equal(first[name], second[name])
    assert again.tiles.lattice == far.tiles.lattice


def test_zones_and_costmaps_of_earlier_versions_are_read():
    far = far_at([0.0, 0.0, 0.0])
    zone, pixels = np.array([[3.0, 4.0], [5.0, 4.0], [5.0, 6.0]]), np.array([[1.0, 1.0]])
    arrays = {n: x for n, x in far_arrays(far).items() if not n.startswith("columns.")}
    arrays |= {"zones.0": zone, "costs.corner": pixels, "costs.edge": np.array(0.5)}
    again = far_of(arrays, CONFIG, CAMERA)
    np.testing.assert_array_equal(again.columns[KEEP_OUT], polygon_columns(far.plane, zone))
    np.testing.assert_array_equal(again.columns[COSTMAP], pixel_columns(far.plane, pixels, 0.5))
    assert len(again.coarse.closed) > 0


@given(
    columns=st.lists(st.tuples(st.integers(-90, 90), st.integers(-90, 90)), max_size=20),
    x=st.floats(-9.0, 9.0),
    mark=st.sampled_from([KEEP_OUT, COSTMAP, TRUSTED]),
)
@settings(max_examples=20, deadline=None)
def test_marks_stay_where_they_are_when_the_block_moves(columns, x, mark):
    """At every block, the marked columns lie at the same places in the world."""
    far = with_columns(far_at([0.0, 0.0, 0.0]), {mark: np.array(columns, np.int64).reshape(-1, 2)})
    lattice, middle = far.tiles.lattice, far.tiles.lattice.tiles_of(np.array([[x], [0.0], [0.0]]))
    far = replace(far, tiles=replace(far.tiles, middle=tuple(middle[:, 0].tolist())))
    grid, first = far.grid(np.zeros(lattice.shape, np.float32)), far.first_cell[:2]
    marked = np.argwhere(((np.asarray(grid.marks) & mark) > 0).all(axis=2))
    places = np.asarray(grid.origin, np.float64)[:2] + (marked + 0.5) * lattice.cell_size
    found = np.floor((places - lattice.origin[:2]) / lattice.cell_size).astype(int)
    is_at_hand = lambda column: np.all((column >= first) & (column < first + lattice.shape[:2]))
    assert set(map(tuple, found.tolist())) == {c for c in columns if is_at_hand(np.array(c))}


def test_a_loaded_coarse_level_is_used_as_it_is_by_the_same_robot_only():
    zone = np.array([[30.0, 0.4], [30.6, 0.4], [30.6, 0.7], [30.0, 0.7]])
    far = the_ring()
    far = updated(with_columns(far, {KEEP_OUT: polygon_columns(far.plane, zone)}))
    again = far_of(far_arrays(far), CONFIG, CAMERA)
    assert again.coarse.tiles.keys() == far.coarse.tiles.keys()
    after = updated(again)
    for tile, summary in again.coarse.tiles.items():
        assert after.coarse.tiles[tile] is summary
    for other in (updated(replace(again, coarse=replace(again.coarse, tiles={}, links={}))), after):
        assert_same_coarse(other.coarse, far.coarse)
    wider = a_policy(safety_margin=0.6)
    assert_same_coarse(updated(again, policy=wider).coarse, updated(far, policy=wider).coarse)
    num_open = lambda coarse: sum(int((x.node >= 0).sum()) for x in coarse.tiles.values())
    assert num_open(updated(again, policy=wider).coarse) < num_open(far.coarse)
    old = {name: x for name, x in far_arrays(far).items() if not name.startswith("coarse.")}
    assert_same_coarse(updated(far_of(old, CONFIG, CAMERA)).coarse, far.coarse)


def assert_same_coarse(a, b):
    arrays, others = coarse_arrays(a), coarse_arrays(b)
    assert arrays.keys() == others.keys()
    for name, values in arrays.items():
        np.testing.assert_array_equal(values, others[name])
