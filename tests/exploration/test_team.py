"""Several cameras, one map: what all have told each other is what one camera would know.

Laws on a box room; oracles for the order of events, worked out by hand from the rows.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r3jax.exploration import explore
from r3jax.exploration.guard import OracleReadError
from r3jax.exploration.replay import after_frame
from r3jax.exploration.state import StopReason
from r3jax.exploration.step import first_grid
from r3jax.exploration.team import Member, explore_team
from r3jax.geometry.cameras import Camera, pose_along
from r3jax.mapping.state import empty_map
from r3jax.trace.images import stored_form
from tests.exploration.killed_run import CONFIG, small_policy
from tests.exploration.test_guard import Cheat
from tests.exploration.toys import BoxRoom, Wander

WIDE = Camera.from_fov(32, 32, 100.0)
VIEWS = 5


def room(x=1.2, camera=None):
    pose = pose_along(jnp.array([x, 1.1, 1.3]), jnp.array([1.0, 0.3, 0.0]))
    fields = {} if camera is None else {"camera": camera}
    return BoxRoom(start_pose=np.asarray(pose, np.float64), **fields)


def wanderers(lenses=(None, WIDE), **settings):
    return [
        Member(room(1.2 + 0.7 * number, lens), Wander(**settings))
        for number, lens in enumerate(lenses)
    ]


def assert_equal(a, b):
    """Bit for bit, array by array."""
    leaves, others = jax.tree.leaves(a), jax.tree.leaves(b)
    assert len(leaves) == len(others)
    for x, y in zip(leaves, others, strict=True):
        np.testing.assert_array_equal(np.asarray(x), np.asarray(y))


def of_one_camera(members, result, config=CONFIG):
    """The map and the grid after all frames, taken again from the recorded poses by the clock."""
    box = members[0].simulator.bounds
    grid = first_grid(box, [m.simulator.start_pose for m in members], config)
    map_state = empty_map(config.capacity, config.voxel_size, config.num_bins)
    rows = [(row.seconds, n, row) for n, r in enumerate(result.members) for row in r.rows]
    for _, number, row in sorted(rows, key=lambda item: item[:2]):
        frame = stored_form(members[number].simulator.render(np.asarray(row.pose, np.float64)))
        map_state, grid = after_frame(map_state, grid, frame, config)
    return map_state, grid


@pytest.mark.parametrize("name", ["wander", "ours-pano"])
def test_a_team_of_one_is_the_camera_alone(name):
    policy = Wander() if name == "wander" else small_policy(name)
    alone = explore(BoxRoom(), policy, budget=f"views:{VIEWS}", seed=3, config=CONFIG)
    member = Member(BoxRoom(), policy)
    for meet_every in (0.0, 1.0):
        team = explore_team(
            [member], budget=f"views:{VIEWS}", seed=3, config=CONFIG, meet_every=meet_every
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


def law_merged_is_one_cameras(seed, meet_every, reach, explore_team=explore_team):
    members = wanderers((None, WIDE, None), reach=reach)
    result = explore_team(members, budget="views:4", seed=seed, config=CONFIG, meet_every=meet_every)
    map_state, grid = of_one_camera(members, result)
    for member in result.members:
        assert_equal(member.state.map_state, map_state)
        assert_equal(member.state.grid, grid)
    assert_equal((result.map_state, result.grid), (map_state, grid))


@settings(max_examples=8)
@given(
    st.integers(0, 1000), st.sampled_from([0.0, 0.4, 1.0, 100.0]), st.sampled_from([0.2, 0.8, 1.4])
)
def test_the_merged_map_is_that_of_one_camera(seed, meet_every, reach):
    law_merged_is_one_cameras(seed, meet_every, reach)
