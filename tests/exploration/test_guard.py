"""No policy sees from where the camera is not: none has the simulator, the loop's is locked."""

import functools
import gc
import sys
import types
from dataclasses import dataclass, field

import numpy as np
import pytest

from r3jax.exploration import explore
from r3jax.exploration.config import ExplorationConfig
from r3jax.exploration.guard import GuardedSimulator, OracleReadError
from r3jax.planning.registry import make_policy, policy_names
from tests.exploration.toys import BoxRoom, Wander
from tests.tiers import quick_and_full

CONFIG = ExplorationConfig(voxel_size=0.1, capacity=1 << 14, clock="model", num_probes=4)


def reachable(*roots):
    """Every object that these hold on to: fields, closures, defaults, bound objects, classes.

    Modules, and with them the globals of functions, are the same for everybody and left out.
    """
    seen, stack = {}, list(roots)
    while stack:
        thing = stack.pop()
        if id(thing) in seen or isinstance(thing, types.ModuleType | types.FrameType):
            continue
        seen[id(thing)] = thing
        if isinstance(thing, types.FunctionType):
            stack += [thing.__closure__, thing.__defaults__, thing.__kwdefaults__, thing.__dict__]
        elif isinstance(thing, type):
            # Other packages' classes know each other, and through them the whole process.
            stack += list(vars(thing).values()) if thing.__module__.startswith("r3jax") else []
        elif not type(thing).__module__.startswith(("jax", "numpy")):
            stack += gc.get_referents(thing)
    return list(seen.values())


def holds_simulator(*roots):
    return any(isinstance(thing, BoxRoom | GuardedSimulator) for thing in reachable(*roots))


@dataclass
class Watched:
    """A policy, looked through before and after everything that it is asked."""

    inner: object
    looks: int = 0

    @property
    def name(self):
        return self.inner.name

    def _search(self, state):
        assert not holds_simulator(self.inner, state)
        self.looks += 1

    def init(self, camera, grid, *, key):
        state = self.inner.init(camera, grid, key=key)
        self._search(state)
        return state

    def observe(self, state, map_state, frame):
        # The arguments are all that a policy ever gets.
        assert not holds_simulator(map_state, frame)
        state = self.inner.observe(state, map_state, frame)
        self._search(state)
        return state

    def decide(self, state, map_state, grid, T_world_camera, *, key):
        decision, state, info = self.inner.decide(state, map_state, grid, T_world_camera, key=key)
        self._search((decision, state, info))
        return decision, state, info

    def follow(self, state, map_state, grid, T_world_camera, waypoints):
        return self.inner.follow(state, map_state, grid, T_world_camera, waypoints)


@pytest.mark.parametrize(
    "name",
    quick_and_full(
        policy_names(),
        ["r3-pano"],
        slow=set(policy_names()) - {"r3-pano", "r3-ahead", "active-gs", "active-gamer", "cover"},
    ),
)
def test_no_policy_holds_the_simulator(name):
    policy = Watched(make_policy(name, num_candidates=20, num_frontier=6))
    result = explore(BoxRoom(), policy, budget="views:3", config=CONFIG)
    assert len(result.rows) == 3
    assert policy.looks == 1 + 3 + 2


@dataclass
class Holder:
    thing: object = None
    things: dict = field(default_factory=dict)

    def render(self, pose): ...


HIDING_PLACES = {
    "field": lambda world: Holder(world),
    "nested": lambda world: Holder(things={"a": [(1, world)]}),
    "method": lambda world: Holder(world.render),
    "closure": lambda world: lambda pose: world.render(pose),
    "default": lambda world: lambda pose, world=world: None,
    "partial": lambda world: functools.partial(print, world),
    "generator": lambda world: (world for _ in range(3)),
}


@pytest.mark.parametrize("place", HIDING_PLACES)
def test_the_search_finds_a_hidden_simulator(place):
    assert not holds_simulator(HIDING_PLACES[place](Holder()))
    assert holds_simulator(HIDING_PLACES[place](BoxRoom()))


@dataclass
class Cheat(Wander):
    """Takes the loop's simulator off the stack and looks where it would like to go."""

    look: str = "elsewhere"

    def decide(self, state, map_state, grid, T_world_camera, *, key):
        answer = super().decide(state, map_state, grid, T_world_camera, key=key)
        frame = sys._getframe()
        while "mission" not in frame.f_locals:
            frame = frame.f_back
        simulator = frame.f_locals["mission"].simulator
        if self.look == "elsewhere":
            simulator.render(answer[0].T_world_camera)
        elif self.look == "here again":
            simulator.render(T_world_camera)
        else:
            simulator.commit(state["frames"], answer[0].T_world_camera)
            simulator.render(answer[0].T_world_camera)
        return answer


@pytest.mark.parametrize("look", ["elsewhere", "here again", "behind the loop's back"])
def test_a_policy_that_smuggles_the_simulator_in_ends_the_run(look):
    world = BoxRoom()
    with pytest.raises(OracleReadError):
        explore(world, Cheat(look=look), budget="views:3", config=CONFIG)
    assert len(world.rendered) == (2 if look.startswith("behind") else 1)


def test_the_guard_shows_each_committed_pose_once():
    world = BoxRoom()
    guarded = GuardedSimulator(world)
    start, other = world.start_pose, world.start_pose.copy()
    other[0, 3] += 1e-6
    with pytest.raises(OracleReadError):
        guarded.render(start)
    guarded.commit(0, start)
    with pytest.raises(OracleReadError):
        guarded.render(other)
    np.testing.assert_array_equal(guarded.render(start).rgb, world.render(start).rgb)
    with pytest.raises(OracleReadError):
        guarded.render(start)
    with pytest.raises(OracleReadError, match="view 0"):
        guarded.commit(0, other)


def test_what_the_guard_tells_of_the_world_cannot_be_written_through():
    world = BoxRoom()
    guarded = GuardedSimulator(world)
    for name in ("start_pose", "bounds"):
        getattr(guarded, name)[:] = 0.0
        np.testing.assert_array_equal(getattr(guarded, name), getattr(world, name))
    assert guarded.camera is world.camera
