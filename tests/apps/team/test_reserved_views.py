"""Deciding beside others: what they promise counts as seen, what is nearer to them is theirs.

Oracles: brute force over the cells of two small rooms, and what the same view is worth afterwards.
"""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r3jax.apps.team.team import PromisedView, ReservedViews, without_yielded
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.planning.policy import DecisionOutcome, PlanInfo
from r3jax.scoring.simulated import imagine_view, simulate_view
from r3jax.scoring.utility import view_utility
from tests.exploration.toys import Wander
from tests.planning.rooms import center, grid_of, pose_at, two_rooms
from tests.scoring.test_simulated import CAMERA, CONFIG, poses_of, seen_map

pytestmark = pytest.mark.full

WORLD = OccupancyGrid(
    log_odds=jnp.zeros((20, 20, 16)).at[3:8].set(-3.0),
    origin=jnp.asarray([-1.0, -2.0, -1.6]),
    cell_size=jnp.asarray(0.2),
)
"""Round the map of `seen_map`; a slice of it is known to be free."""


def half_explored() -> tuple[np.ndarray, OccupancyGrid]:
    """Two rooms of which the far half is unexplored in each: known free cells, and the grid."""
    free, occupied = two_rooms()
    hidden = np.zeros_like(free)
    hidden[1:5], hidden[20:24] = True, True
    return free & ~hidden, grid_of(free & ~hidden, occupied & ~hidden)


def assert_nearer_are_yielded(here, others) -> None:
    free, grid = half_explored()
    places = np.array([center(*cell) for cell in others])
    own = without_yielded(
        grid, jnp.asarray(center(*here), jnp.float32), jnp.asarray(places, jnp.float32)
    )
    np.testing.assert_array_equal(own.log_odds, grid.log_odds)
    before, after = np.asarray(grid.unexplored), np.asarray(own.unexplored)
    for cell in np.ndindex(free.shape):
        mine = np.linalg.norm(center(*cell) - center(*here))
        theirs = np.linalg.norm(center(*cell) - places, axis=1).min()
        if abs(mine - theirs) < 1e-4:
            continue  # a tie but for rounding
        assert after[cell] == (before[cell] and mine < theirs), cell


cells = st.tuples(st.integers(6, 11), st.integers(1, 12), st.integers(1, 8))


@settings(max_examples=10)
@given(cells, st.tuples(st.integers(13, 18), st.integers(1, 12), st.integers(1, 8)))
def test_what_is_nearer_to_others_is_theirs(here, other):
    assert_nearer_are_yielded(here, (other,))


def test_of_several_others_the_nearest_counts():
    assert_nearer_are_yielded((9, 6, 4), ((15, 6, 4), (7, 11, 2)))


def test_a_camera_that_has_nothing_left_yields_nothing():
    free, occupied = two_rooms()
    hidden = np.zeros_like(free)
    hidden[20:24] = True
    grid = grid_of(free & ~hidden, occupied & ~hidden)
    here, other = (jnp.asarray(center(*cell), jnp.float32) for cell in ((5, 6, 4), (17, 6, 4)))
    after = without_yielded(grid, here, other[None])
    np.testing.assert_array_equal(after.unexplored, grid.unexplored)


def test_a_promised_view_has_nothing_more_to_explore():
    """The same view explores nothing any more; the map is the foreseen one, and nothing else."""
    state, (pose, _) = seen_map(), poses_of(3)
    after, dark = imagine_view(state, WORLD, CAMERA, pose, CONFIG)
    first = view_utility(state, WORLD, CAMERA, pose, CONFIG)
    again = view_utility(after, dark, CAMERA, pose, CONFIG)
    assert first.exploration > 100.0
    assert again.exploration == 0.0
    assert again.rendering < first.rendering
    foreseen, _ = simulate_view(state, CAMERA, pose, CONFIG)
    for name in ("visited", "resolution", "count", "mean", "m2", "key"):
        np.testing.assert_array_equal(getattr(after, name), getattr(foreseen, name))
    np.testing.assert_array_equal(dark.log_odds, WORLD.log_odds)
    changed = np.asarray(dark.unexplored) != np.asarray(WORLD.unexplored)
    assert changed.sum() == float(first.exploration)


INFO = PlanInfo(DecisionOutcome.NO_CANDIDATE, 0, 0)
KEY = jax.random.key(0)


@dataclass
class Listener(Wander):
    """Keeps what it was asked to decide on."""

    name: str = "listener"
    config: str = "settings"
    received: list = field(default_factory=list)

    def decide(self, state, map_state, grid, T_world_camera, *, key):
        self.received.append((state, map_state, grid, T_world_camera, key))
        return None, "state", INFO


def test_a_policy_decides_on_what_others_leave():
    """The policy decides where the camera is, on every promise, and on what is left to it."""
    listener = Listener()
    state, poses, pose = seen_map(), poses_of(3), pose_at(np.array([-0.5, -1.0, 0.0]))
    views = tuple(PromisedView(CAMERA, np.asarray(T, np.float64)) for T in poses)
    policy = ReservedViews(listener, views, CONFIG)
    assert (policy.name, policy.config) == ("listener", "settings")
    answer = policy.decide("memory", state, WORLD, pose, key=KEY)
    assert answer == (None, "state", INFO)
    ((memory, map_state, grid, T, key),) = listener.received
    assert (memory, key) == ("memory", KEY)
    np.testing.assert_array_equal(T, pose)
    after, dark = state, WORLD
    for view in poses:
        after, dark = imagine_view(after, dark, CAMERA, view, CONFIG)
    others = jnp.stack([view[:3, 3] for view in poses])
    left = without_yielded(dark, jnp.asarray(pose[:3, 3], jnp.float32), others)
    np.testing.assert_array_equal(map_state.visited, after.visited)
    np.testing.assert_array_equal(grid.unexplored, left.unexplored)
