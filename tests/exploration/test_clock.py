"""The mission clock: compilation is not charged, and the model clock never looks at the time."""

import itertools

import jax
import jax.numpy as jnp
import pytest

from r3jax.exploration import state
from r3jax.exploration.config import ExplorationConfig
from r3jax.exploration.state import make_clock, timed


@pytest.fixture
def ticking(monkeypatch):
    """Every look at the clock is one second later than the one before."""
    ticks = itertools.count()
    monkeypatch.setattr(state.time, "perf_counter", lambda: float(next(ticks)))


def test_a_call_that_compiles_is_made_again_and_only_then_timed(ticking):
    calls = []
    double = jax.jit(lambda x: x * 2.0)

    def function(x):
        calls.append(float(x))
        return double(x)

    x = jnp.asarray(3.0)
    result, seconds = timed(function, x, repeat_compiled=True)
    assert (float(result), seconds, len(calls)) == (6.0, 1.0, 2)
    timed(function, x, repeat_compiled=True)
    assert len(calls) == 3  # nothing left to compile


def test_without_need_for_the_time_nothing_is_repeated(ticking):
    calls = []
    triple = jax.jit(lambda x: x * 3.0)
    timed(lambda x: calls.append(x) or triple(x), jnp.asarray(1.0), repeat_compiled=False)
    assert len(calls) == 1


def test_wall_charges_what_was_measured_and_model_its_fixed_cost():
    assert make_clock(ExplorationConfig(clock="wall")).charge("planning", 1.25) == 1.25
    model = make_clock(ExplorationConfig(clock="model"))
    assert model.charge("planning", 1.25) == model.charge("planning", 77.0) > 0.0
    assert model.charge("mapping", 1.25) == model.charge("mapping", 77.0) > 0.0


def test_the_model_clock_charges_a_decision_and_a_frame_what_the_settings_say():
    clock = make_clock(ExplorationConfig(clock="model", planning_seconds=5.0, mapping_seconds=2.8))
    assert [clock.charge(stage, 0.0) for stage in ("planning", "mapping")] == [5.0, 2.8]
