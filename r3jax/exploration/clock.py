"""The mission clock: planning + mapping + flight. The simulator and the disk do not count."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar, runtime_checkable

import jax

from r3jax.exploration.config import ExplorationConfig

T = TypeVar("T")


@runtime_checkable
class Clock(Protocol):
    """Converts the measured time of a stage into the time charged to the mission."""

    @property
    def measures(self) -> bool:
        """True if the charge depends on the measured time."""
        ...

    def charge(self, stage: str, measured: float) -> float:
        """Returns the seconds to charge for one call of a stage that took `measured` [s]."""
        ...


@dataclass(frozen=True)
class WallClock:
    """Charges the measured time."""

    measures: bool = True

    def charge(self, stage: str, measured: float) -> float:
        """Returns the measured time itself."""
        return measured


@dataclass(frozen=True)
class ModelClock:
    """Charges a fixed cost per stage, so that runs are repeatable."""

    costs: dict[str, float]
    """Seconds per call, by stage; `reconsidering` a decision that was made while moving, `gaze` per
    frame that is captured while moving."""

    measures: bool = False

    def charge(self, stage: str, measured: float) -> float:
        """Returns the fixed cost of the stage."""
        return self.costs[stage]


def model_clock(config: ExplorationConfig) -> ModelClock:
    """Makes the clock of fixed costs; the costs of a decision and of a frame are settings."""
    return ModelClock(
        {
            "planning": config.planning_seconds,
            "reconsidering": 0.05,
            "mapping": config.mapping_seconds,
            "gaze": 0.01,
        }
    )


def make_clock(config: ExplorationConfig) -> Clock:
    """Makes the clock that the settings name: `wall` or `model`."""
    return WallClock() if config.clock == "wall" else model_clock(config)


class _Compilations:
    """Counts compilations of this process, from JAX's own events."""

    def __init__(self):
        self.count = 0
        jax.monitoring.register_event_duration_secs_listener(self._listen)

    def _listen(self, event: str, duration_secs: float, **kwargs: str | int) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            self.count += 1


compilations = _Compilations()
"""Of this process, so far."""


def timed(
    function: Callable[..., T], *args: Any, repeat_compiled: bool, **kwargs: Any
) -> tuple[T, float]:
    """Calls a pure function and measures its time without compilation.

    Compilation is an artifact of this software (and absent in a second run, thanks to the
    persistent cache), so it is not charged to the mission. If anything was compiled during the
    call, the call is repeated and the second one is timed; the result is the same, because the
    function is pure.

    Args:
        function: a pure function of its arguments.
        *args: its arguments.
        repeat_compiled: False if the exact time is not needed.
        **kwargs: its keyword arguments.

    Returns:
        The result, ready, and its time [s].
    """
    # Events, not a warm-up call: a growing map causes recompilation during the mission.
    before = compilations.count
    result, seconds = _measure(function, *args, **kwargs)
    if repeat_compiled and compilations.count > before:
        result, seconds = _measure(function, *args, **kwargs)
    return result, seconds


def _measure(function: Callable[..., T], *args: Any, **kwargs: Any) -> tuple[T, float]:
    # JAX returns before the device is done: without waiting only the dispatch would be charged.
    start = time.perf_counter()
    result = jax.block_until_ready(function(*args, **kwargs))
    return result, time.perf_counter() - start
