"""Sizes come to rest: what a run needs is compiled in its first decisions, and never again."""

from dataclasses import dataclass, field

import jax
import pytest

from r3jax.exploration import explore
from r3jax.exploration.config import ExplorationConfig
from r3jax.geometry.cameras import Camera
from r3jax.planning.registry import make_policy
from r3jax.simulators.scenes.registry import open_scene

SETTLED = 10
"""Decisions after which nothing is compiled."""

VIEWS = 16


@dataclass
class Compilations:
    """Counts programs, those that the disk gives included."""

    count: int = 0
    after_view: list[int] = field(default_factory=list)
    """Programs so far, after each view."""

    def listen(self, event: str, duration_secs: float, **_) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            self.count += 1

    def on_view(self, view, planner) -> None:
        del view, planner
        self.after_view.append(self.count)


@pytest.mark.full
@pytest.mark.parametrize("policy", ["r3", "r3-pano", "r3-ahead"])
def test_nothing_is_compiled_after_the_tenth_decision(policy):
    jax.clear_caches()  # as in a process of its own: programs of other tests would hide its own
    seen = Compilations()
    jax.monitoring.register_event_duration_secs_listener(seen.listen)
    try:
        explore(
            open_scene("flat", camera=Camera.from_fov(48, 48), seed=1),
            make_policy(policy),
            budget=f"views:{VIEWS}",
            seed=2,
            config=ExplorationConfig(clock="model", capacity=1 << 15, num_probes=1),
            on_view=seen.on_view,
        )
    finally:
        jax.monitoring.unregister_event_duration_listener(seen.listen)
    assert seen.after_view[0] > 0
    # The first view is where the run begins: decision k leads to view k + 1.
    assert seen.after_view[-1] == seen.after_view[SETTLED], seen.after_view
