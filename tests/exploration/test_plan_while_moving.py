"""Decisions that are made during the flight: on what, at what cost, and how they are put right."""

from dataclasses import replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.exploration import explore
from r3jax.planning.decide import RECONSIDERED, look_round
from r3jax.planning.planner import decide, decide_ahead, observe, reconsider
from r3jax.runs.reader import read_run
from r3jax.runs.rows import from_json, to_json
from r3jax.scoring.simulated import imagine_view
from r3jax.scoring.utility import view_utility
from tests.exploration.killed_run import CONFIG, SCORING, small_policy
from tests.exploration.test_captures import cut_off, record
from tests.exploration.test_resume import assert_same_run
from tests.exploration.toys import BoxRoom, Wander
from tests.tiers import quick_and_full

MOVING = replace(CONFIG, plan_while_moving=True)
SEEN = replace(MOVING, capture_every=0.2)
KEY = jax.random.key(7)


def planner_after(views: int, name: str = "r3"):
    """A planner that has seen some views of the room, and where the camera is."""
    simulator = BoxRoom()
    result = explore(simulator, small_policy(name), budget=f"views:{views}", config=CONFIG)
    return result.state.planner, result.state.T_world_camera, simulator


def test_the_clock_is_charged_for_what_the_flight_does_not_hide():
    """0.3 s of planning, 0.05 s on arrival: all but what the flight before took."""
    rows = explore(BoxRoom(), small_policy("r3"), budget="views:7", config=MOVING).rows
    assert rows[1].charged["planning"] == 0.3  # nothing was flown before
    assert rows[1].hidden == 0.0
    for before, row in pairwise(rows[1:]):
        flight = before.charged["flight"]
        assert row.hidden == pytest.approx(min(0.3, flight))
        assert row.charged["planning"] == pytest.approx(0.35 - row.hidden)
        assert row.seconds == pytest.approx(before.seconds + sum(row.charged.values()))
        assert from_json(to_json(row)).hidden == row.hidden
    assert max(row.hidden for row in rows) > 0.1


def test_a_flight_with_captures_hides_as_much_as_it_takes_in_all():
    rows = explore(BoxRoom(), small_policy("r3-pano"), budget="views:5", config=SEEN).rows
    ends = [i for i, row in enumerate(rows) if not row.captured]
    for a, b in pairwise(ends[1:]):
        leg, first = rows[ends[ends.index(a) - 1] + 1 : a + 1], rows[a + 1]
        assert b > a
        flight = sum(row.charged["flight"] for row in leg)
        assert first.hidden == pytest.approx(min(0.3, flight))
        assert all(row.hidden == 0.0 for row in rows[a + 2 : b + 1])


def test_it_decides_on_the_map_as_the_next_view_is_expected_to_leave_it():
    planner, here, simulator = planner_after(3)
    target, _, _ = decide(planner, here, KEY)
    assert target is not None
    T = target.T_world_camera
    ahead, after, _ = decide_ahead(planner, simulator.camera, T, KEY, SCORING)
    assert ahead is not None
    pose = jnp.asarray(T, jnp.float32)
    map_state, grid = imagine_view(planner.map_state, planner.grid, simulator.camera, pose, SCORING)
    expected, _, _ = decide(replace(planner, map_state=map_state, grid=grid), T, KEY)
    assert expected is not None
    np.testing.assert_array_equal(ahead.T_world_camera, expected.T_world_camera)
    np.testing.assert_array_equal(ahead.waypoints[0], T[:3, 3])
    # Nothing was flown or looked at: the memory of both is as it was.
    np.testing.assert_array_equal(after.policy_state.trail, planner.policy_state.trail)
    np.testing.assert_array_equal(after.policy_state.looks, planner.policy_state.looks)
    np.testing.assert_array_equal(after.map_state.count, planner.map_state.count)


def test_on_arrival_the_best_are_scored_again_on_what_has_come_in():
    planner, here, simulator = planner_after(3)
    target, _, _ = decide(planner, here, KEY)
    T = target.T_world_camera
    ahead, _, _ = decide_ahead(planner, simulator.camera, T, KEY, SCORING)
    arrived = observe(planner, simulator.render(T))
    decision, _, info = reconsider(arrived, T, ahead, KEY)
    assert decision is not None
    assert info.num_candidates == min(RECONSIDERED, len(ahead.candidates))
    total = np.where(np.isfinite(ahead.utilities["path"]), ahead.utilities["total"], -np.inf)
    best = ahead.candidates[np.argsort(-total, kind="stable")[:RECONSIDERED]]
    np.testing.assert_allclose(decision.candidates, best, atol=1e-6)
    # Their utilities are those of the map now, cell by cell worth a look now.
    policy = planner.policy
    _, where = look_round(arrived.policy_state, arrived.map_state, arrived.grid, T, policy.config)
    for pose, utility in zip(decision.candidates, decision.utilities["utility"], strict=True):
        expected = view_utility(
            arrived.map_state,
            where.scoring_grid,
            simulator.camera,
            jnp.asarray(pose, jnp.float32),
            SCORING,
        )
        np.testing.assert_allclose(utility, float(expected.total), rtol=1e-4)
    chosen = int(np.argmax(decision.utilities["total"]))
    np.testing.assert_array_equal(decision.T_world_camera, decision.candidates[chosen])


def test_what_no_path_leads_to_any_more_is_decided_anew():
    planner, here, _ = planner_after(3)
    ahead, _, _ = decide(planner, here, KEY)
    assert ahead is not None
    outside = np.array(ahead.candidates)
    outside[:, :3, 3] += 50.0
    decision, _, _ = reconsider(planner, here, replace(ahead, candidates=outside), KEY)
    assert decision is None


@pytest.mark.parametrize("name", quick_and_full(["frontier", "active-gamer", "r3-ahead"], []))
def test_every_policy_can_plan_on_the_way(name):
    rows = explore(BoxRoom(), small_policy(name), budget="views:6", config=MOVING).rows
    assert len(rows) == 6
    assert max(row.hidden for row in rows) > 0.0


def test_a_policy_that_cannot_reconsider_decides_on_arrival():
    rows = explore(BoxRoom(), Wander(reach=1.2), budget="views:4", config=MOVING).rows
    plain = explore(BoxRoom(), Wander(reach=1.2), budget="views:4", config=CONFIG).rows
    assert [to_json(row) for row in rows] == [to_json(row) for row in plain]


RUNS = {"blind": (MOVING, "views:7"), "captures": (SEEN, "frames:14")}


@pytest.mark.parametrize("name", quick_and_full(RUNS, ["captures"]))
def test_a_run_that_is_cut_off_goes_on_as_if_it_had_not_been(tmp_path, name):
    config, budget = RUNS[name]
    policy = small_policy("r3-pano")
    whole, _ = record(tmp_path / "whole", policy, config, budget)
    cut = len(whole.rows) // 2
    for how in ("stopped", "killed"):
        path = tmp_path / how
        record(path, policy, config, budget.split(":")[0] + f":{cut + 1}")
        if how == "killed":
            cut_off(path, cut)
        record(path, policy, config, budget)
        assert_same_run(path, tmp_path / "whole")
    assert max(row.hidden for row in read_run(tmp_path / "whole").rows) > 0.0
