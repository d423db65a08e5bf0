"""The next size of a map is ready before the map is full, and what is ready changes nothing."""

import subprocess
import sys

import jax
import numpy as np
import pytest

import r3jax
from r3jax.planning import growth
from tests.apps.audit.room import LENS, SIZE, picture, round_poses

pytestmark = pytest.mark.full

POSES = round_poses(6)


def mapped(capacity, ahead=None):
    """The planner after all frames, and how large it was after each."""
    config = r3jax.MappingConfig(capacity=capacity)
    bounds = np.stack([np.zeros(3), SIZE])
    planner = r3jax.start(LENS.camera, bounds, "random", starts=[POSES[0]], config=config)
    sizes = []
    for pose in POSES:
        frame = r3jax.Frame.from_arrays(*picture(pose), pose, LENS.camera)
        planner = r3jax.observe(planner, frame)
        sizes.append(planner.map_state.capacity)
        if ahead is not None:
            ahead.look(planner, frame)
            ahead.wait()
    return planner, sizes


def test_the_next_size_is_prepared_once_before_it_is_needed(monkeypatch):
    prepared = []
    real = growth._compile
    monkeypatch.setattr(growth, "_compile", lambda *args: (prepared.append(args[2]), real(*args)))
    planner, sizes = mapped(1 << 11, growth.GrowthAhead())
    assert sizes[-1] > sizes[0]
    assert prepared == sorted(set(prepared))
    grown = set(sizes) - {sizes[0]}
    assert grown <= set(prepared)
    plain, _ = mapped(1 << 11)
    for with_it, without in zip(*(jax.tree.leaves(p.map_state) for p in (planner, plain)),
                                strict=True):  # fmt: skip
        np.testing.assert_array_equal(with_it, without)


def test_nothing_is_prepared_where_there_is_room_or_no_growth(monkeypatch):
    prepared = []
    monkeypatch.setattr(growth, "_compile", lambda *args: prepared.append(args))
    mapped(1 << 18, growth.GrowthAhead())
    assert prepared == []


def test_a_process_that_ends_waits_for_what_is_being_prepared():
    """XLA aborts a process that ends while it compiles."""
    program = """
import time
from types import SimpleNamespace as Any
from r3jax.planning import growth
growth._compile = lambda *args: (time.sleep(0.5), print("prepared"))
state, config = Any(capacity=64, num_occupied=32), Any(allow_growth=True)
growth.GrowthAhead().look(Any(map_state=state, far=None, config=config), None)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "prepared\n"), done.stderr
