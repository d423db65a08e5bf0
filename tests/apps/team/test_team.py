"""Several cameras, one map: what all have shared is what one camera would know.

Laws on a box room. What a member may know when it decides is worked out from the rows alone.
"""

from collections import Counter
from dataclasses import dataclass, field, replace
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r3jax.apps.team import team as real_team
from r3jax.apps.team.team import Member, explore_team, without_yielded
from r3jax.exploration import explore
from r3jax.exploration.guard import OracleReadError
from r3jax.exploration.state import StopReason
from r3jax.exploration.taken_views import stored_form
from r3jax.geometry.cameras import Camera, pose_along
from r3jax.mapping.state import empty_map
from r3jax.planning.planner import add_frame, first_grid
from r3jax.planning.policy import Decision, DecisionOutcome, PlanInfo
from r3jax.scoring.batch import score_views
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.simulated import imagine_view
from tests.exploration.killed_run import CONFIG, SCORING, small_policy
from tests.exploration.test_guard import Cheat
from tests.exploration.toys import BoxRoom, Wander

WIDE = Camera.from_fov(32, 32, 100.0)
VIEWS = 5
MAPPING = 0.02
"""What the model clock charges for a frame [s]."""


def room(x=1.2, camera=None):
    pose = pose_along(jnp.array([x, 1.1, 1.3]), jnp.array([1.0, 0.3, 0.0]))
    fields = {} if camera is None else {"camera": camera}
    return BoxRoom(start_pose=np.asarray(pose, np.float64), **fields)


def wanderers(lenses=(None, WIDE), policy=Wander, **settings):
    return [
        Member(room(1.2 + 0.7 * number, lens), policy(**settings))
        for number, lens in enumerate(lenses)
    ]


def assert_equal(a, b):
    """Bit for bit, array by array."""
    leaves, others = jax.tree.leaves(a), jax.tree.leaves(b)
    assert len(leaves) == len(others)
    for x, y in zip(leaves, others, strict=True):
        np.testing.assert_array_equal(np.asarray(x), np.asarray(y))


def frames_by_clock(members, result):
    """Clock, member and frame of every view, taken again from the recorded poses, in order."""
    rows = [(row.seconds, n, row) for n, r in enumerate(result.members) for row in r.rows]
    return [
        (seconds, n, stored_form(members[n].simulator.render(np.asarray(row.pose, np.float64))))
        for seconds, n, row in sorted(rows, key=lambda item: item[:2])
    ]


def of_one_camera(members, frames):
    """The map and the grid of a camera that has taken these frames, one after the other."""
    starts = [member.simulator.start_pose for member in members]
    grid = first_grid(members[0].simulator.bounds, starts, CONFIG)
    map_state = empty_map(CONFIG.capacity, CONFIG.voxel_size, CONFIG.num_bins)
    for frame in frames:
        map_state, grid = add_frame(map_state, grid, frame, CONFIG)
    return map_state, grid


@pytest.mark.full
@pytest.mark.parametrize("name", ["wander", "r3-pano"])
def test_a_team_of_one_is_the_camera_alone(name):
    policy = Wander() if name == "wander" else small_policy(name)
    alone = explore(BoxRoom(), policy, budget=f"views:{VIEWS}", seed=3, config=CONFIG)
    for meet_every in (0.0, 1.0):
        team = explore_team(
            [Member(BoxRoom(), policy)],
            budget=f"views:{VIEWS}",
            seed=3,
            config=CONFIG,
            meet_every=meet_every,
        )
        (result,) = team.members
        for row, other in zip(result.rows, alone.rows, strict=True):
            assert row.sha256 == other.sha256
            assert (row.seconds, row.charged) == (other.seconds, other.charged)
            assert row.coverage == other.coverage
        assert_equal(result.state.map_state, alone.state.map_state)
        assert_equal(result.state.grid, alone.state.grid)
        assert_equal(result.state.policy_state, alone.state.policy_state)
        assert (result.reason, result.message) == (alone.reason, alone.message)
        assert team.seconds == alone.state.seconds


def test_a_team_captures_on_the_way_and_merges_all_of_it():
    """One alone takes the frames that it would take without a team; two tell each other theirs."""
    config = replace(CONFIG, capture_every=0.2, gaze="ahead")
    alone = explore(BoxRoom(), Wander(reach=1.2), budget="views:3", seed=3, config=config)
    member = Member(BoxRoom(), Wander(reach=1.2))
    (one,) = explore_team([member], budget="views:3", seed=3, config=config).members
    assert [row.sha256 for row in one.rows] == [row.sha256 for row in alone.rows]
    members = wanderers(reach=1.2)
    team = explore_team(members, budget="views:3", config=config)
    for result in team.members:
        assert sum(not row.captured for row in result.rows) == 3 < len(result.rows)
    poses = [list(member.simulator.rendered) for member in members]  # not rounded to float32
    rows = [(row.seconds, n, row.step) for n, r in enumerate(team.members) for row in r.rows]
    frames = [
        stored_form(members[n].simulator.render(poses[n][step])) for _, n, step in sorted(rows)
    ]
    map_state, grid = of_one_camera(members, frames)
    assert_equal(team.map_state, map_state)
    assert_equal(team.grid, grid)


@pytest.mark.full
@settings(max_examples=6)
@given(
    st.integers(0, 1000), st.sampled_from([0.0, 0.4, 1.0, 100.0]), st.sampled_from([0.2, 0.8, 1.4])
)
def test_the_merged_map_is_that_of_one_camera(seed, meet_every, reach):
    members = wanderers((None, WIDE, None), reach=reach)
    result = explore_team(
        members, budget="views:4", seed=seed, config=CONFIG, meet_every=meet_every
    )
    frames = frames_by_clock(members, result)
    map_state, grid = of_one_camera(members, [frame for _, _, frame in frames])
    for member in result.members:
        assert len(member.rows) == 4
        assert_equal(member.state.map_state, map_state)
        assert_equal(member.state.grid, grid)
    assert_equal((result.map_state, result.grid), (map_state, grid))
    assert [(v.seconds, v.member) for v in result.views] == [item[:2] for item in frames]
    assert result.views[-1].voxels == int(map_state.num_occupied)
    assert result.views[-1].known_share == 1.0 - np.asarray(grid.unexplored).mean()
    assert result.seconds == max(m.rows[-1].seconds for m in result.members)


@dataclass
class Spy(Wander):
    """Notes what it has been shown, and what it decides on."""

    log: list = field(default_factory=list)

    def init(self, camera, grid, *, key):
        return super().init(camera, grid, key=key) | {"shown": ()}

    def observe(self, state, map_state, frame):
        shown = (*state["shown"], np.asarray(frame.T_world_camera).tobytes())
        return super().observe(state, map_state, frame) | {"shown": shown}

    def decide(self, state, map_state, grid, T_world_camera, *, key):
        self.log.append((state["shown"], map_state, grid))
        return super().decide(state, map_state, grid, T_world_camera, key=key)


@pytest.mark.full
@pytest.mark.parametrize("meet_every", [0.0, 0.9])
def test_nobody_knows_more_or_less_than_was_shared(meet_every):
    """Of every decision: what was shown, the map, whose view counts as taken, and the charge."""
    members = wanderers((None, WIDE), policy=Spy, reach=1.2)
    order = []
    result = explore_team(
        members,
        budget="views:5",
        seed=1,
        config=CONFIG,
        meet_every=meet_every,
        on_row=lambda number, row: order.append((number, row)),
    )
    frames = frames_by_clock(members, result)
    begins = {
        (row.seconds, number): 0.0 if row.choice is None else before.seconds
        for number, m in enumerate(result.members)
        for before, row in zip((None, *m.rows), m.rows, strict=False)
    }
    charges = 0
    for number, member in enumerate(members):
        rows, received = result.members[number].rows, 0.0
        for k, (shown, map_state, grid) in enumerate(member.policy.log[: len(rows) - 1], start=1):
            now = rows[k - 1].seconds
            met = now if meet_every == 0.0 else np.floor(now / meet_every) * meet_every
            common = [item for item in frames if item[0] <= met]
            own = [item for item in frames if item[1] == number and met < item[0] <= now]
            known = [*common, *own]
            shared = [item for item in common if item[1] != number]
            mine = [item for item in frames if item[1] == number and item[0] <= now]
            assert Counter(shown) == Counter(
                np.asarray(frame.T_world_camera).tobytes() for _, _, frame in [*shared, *mine]
            )
            expected = of_one_camera(members, [frame for _, _, frame in known])
            under_way = next((i for i in frames if i[1] != number and i[0] > met), None)
            # Of two that decide at the same time the first one decides first.
            if under_way is not None and (begins[under_way[:2]], under_way[1]) < (now, number):
                frame = under_way[2]
                scoring = ScoringConfig(max_range=jnp.asarray(CONFIG.max_range, jnp.float32))
                after, dark = imagine_view(*expected, frame.camera, frame.T_world_camera, scoring)
                here = np.asarray(rows[k - 1].pose)[:3, 3]
                expected = after, without_yielded(dark, jnp.asarray(here), frame.position[None])
            assert_equal((map_state, grid), expected)
            # Everything shared since the last time, and one's own on top of it once more.
            news = [item for item in common if item[0] > received]
            is_news = any(item[1] != number for item in news)
            charge = MAPPING * (len(news) + len(own)) if is_news else 0.0
            charges += is_news
            received = max(received, met)
            assert rows[k].charged.get("exchange", 0.0) == pytest.approx(charge)
            spent = sum(rows[k].charged.values())
            assert rows[k].seconds == pytest.approx(rows[k - 1].seconds + spent)
    assert charges > 1  # or nothing was shared at all
    turns = [(begins[row.seconds, number], number) for number, row in order]
    assert turns == sorted(turns)
    assert [n for n, _ in order[:2]] == [0, 1]


@pytest.mark.full
def test_everyone_draws_for_itself():
    result = explore_team(wanderers((None, None)), budget="views:2", config=CONFIG)
    first, second = (member.rows[1].choice.score for member in result.members)
    assert first != second


@dataclass
class Turning:
    """Stays where it is and takes the most useful of eight level views."""

    name: str = "turning"

    def init(self, camera, grid, *, key):
        return camera

    def observe(self, state, map_state, frame):
        return state

    def decide(self, state, map_state, grid, T_world_camera, *, key):
        angles = np.arange(8) * np.pi / 4.0
        here = np.asarray(T_world_camera)[:3, 3]
        poses = np.stack(
            [
                np.asarray(pose_along(jnp.asarray(here, jnp.float32), jnp.asarray(d, jnp.float32)))
                for d in np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
            ]
        ).astype(np.float64)
        scores = score_views(map_state, grid, state, poses, SCORING)
        total = np.asarray(scores.total, np.float64)
        best = int(np.argmax(total))
        decision = Decision(
            poses[best], np.stack([here, here]), 0.0, float(total[best]), poses, {"total": total}
        )
        return decision, state, PlanInfo(DecisionOutcome.MOVED, 8, 8)

    def follow(self, state, map_state, grid, T_world_camera, waypoints):
        return state


def first_choices():
    members = [Member(room(x), Turning()) for x in (1.9, 1.95)]
    result = explore_team(members, budget="views:2", config=CONFIG)
    return [tuple(m.rows[1].pose[:3, 2].round(3)) for m in result.members]


@pytest.mark.full
def test_two_cameras_do_not_turn_to_the_same_thing():
    first, second = first_choices()
    assert first != second
    with mock.patch.object(real_team, "_promised_to", return_value=()):
        first, second = first_choices()
    assert first == second  # they would have


@pytest.mark.full
def test_a_member_that_is_done_leaves_the_others_flying():
    members = wanderers()
    members[0].policy.last_step = 1
    result = explore_team(members, budget="views:4", config=CONFIG, meet_every=0.5)
    first, second = result.members
    assert (first.reason, len(first.rows)) == (StopReason.NO_REACHABLE_CANDIDATE, 2)
    assert (second.reason, len(second.rows)) == (StopReason.BUDGET, 4)
    assert_equal(first.state.map_state, second.state.map_state)
    assert result.seconds == second.state.seconds > first.state.seconds


@pytest.mark.parametrize("look", ["elsewhere", "here again"])
def test_no_member_looks_from_where_it_is_not(look):
    members = [Member(room(), Wander()), Member(room(1.9), Cheat(look=look))]
    with pytest.raises(OracleReadError):
        explore_team(members, budget="views:3", config=CONFIG)
    assert len(members[1].simulator.rendered) == 1


@pytest.mark.full
def test_an_interrupt_ends_all_and_all_meet():
    members = wanderers()
    render = members[1].simulator.render

    def interrupted(T):
        if len(members[1].simulator.rendered) == 2:
            raise KeyboardInterrupt
        return render(T)

    members[1].simulator.render = interrupted
    result = explore_team(members, budget="views:9", config=CONFIG, meet_every=100.0)
    assert {m.reason for m in result.members} == {StopReason.INTERRUPTED}
    assert len(result.members[1].rows) == 2
    members[1].simulator.render = render
    frames = [frame for _, _, frame in frames_by_clock(members, result)]
    assert_equal((result.map_state, result.grid), of_one_camera(members, frames))


def test_what_is_no_team_is_refused():
    with pytest.raises(ValueError, match="member"):
        explore_team([], budget="views:2")
    with pytest.raises(ValueError, match="meet_every"):
        explore_team(wanderers(), budget="views:2", meet_every=-1.0)
    elsewhere = BoxRoom(bounds=np.stack([np.zeros(3), np.full(3, 4.0)]))
    with pytest.raises(ValueError, match="member 1"):
        explore_team([Member(room(), Wander()), Member(elsewhere, Wander())], budget="views:2")
