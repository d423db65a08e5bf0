"""What a policy had on offer: caught while it decides, or decided again from the recorded frames.

The trace keeps the utilities of the best candidates, not where they were. Policies are pure, so
the same state and key give the same candidates; whether they do is checked against the trace.
"""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from r3jax.apps.viewer.color_maps import UTILITY_MAP, paint, spread
from r3jax.apps.viewer.overlays import frustum_segments
from r3jax.exploration.budget import parse_budget
from r3jax.exploration.clock import make_clock
from r3jax.exploration.config import ExplorationConfig
from r3jax.exploration.guard import GuardedSimulator
from r3jax.exploration.replay import check_decided_alone
from r3jax.exploration.state import Mission
from r3jax.exploration.step import relive, start_state
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.policy import Decision, PlanInfo, Policy
from r3jax.trace.errors import RunError
from r3jax.trace.reader import Run


@dataclass(frozen=True)
class Offer:
    """The candidates of one decision."""

    poses: np.ndarray
    """`T_world_camera`, [C, 4, 4]."""

    utilities: dict[str, np.ndarray]
    """Per candidate, [C] each; `total` and `path` always."""

    chosen: int
    """Which of them was taken."""


def offer_of(decision: Decision) -> Offer:
    """The candidates of a decision."""
    gap = np.abs(decision.candidates - decision.T_world_camera).max(axis=(1, 2))
    return Offer(decision.candidates, decision.utilities, int(np.argmin(gap)))


def offer_segments(camera: Camera, offer: Offer) -> tuple[np.ndarray, np.ndarray]:
    """Candidates as small frusta, the chosen one larger; yellow scores best, gray is out of reach.

    Returns:
        Ends [s, 2, 3] float32 [m] and colors [s, 2, 3] uint8.
    """
    is_reachable = np.isfinite(offer.utilities["path"])
    scores = spread(np.where(is_reachable, offer.utilities["total"], np.nan))
    parts = [
        frustum_segments(camera, np.asarray(pose), 0.2 if number == offer.chosen else 0.1)
        for number, pose in enumerate(offer.poses)
    ]
    if not parts:
        return np.zeros((0, 2, 3), np.float32), np.zeros((0, 2, 3), np.uint8)
    colors = np.repeat(paint(scores, UTILITY_MAP), len(parts[0]), axis=0)
    return np.concatenate(parts), np.repeat(colors[:, None], 2, axis=1)


class WatchedPolicy:
    """Decides as another policy does, and lets somebody watch. What it returns is the other's."""

    def __init__(
        self,
        policy: Policy,
        on_decision: Callable[[Decision, OccupancyGrid], None],
        on_frame: Callable[[MapState, Frame], None] = lambda map_state, frame: None,
    ):
        """Wraps a policy.

        Args:
            policy: the one that decides.
            on_decision: told every decision, and the grid that it was made on; must be quick, for
                it is on the mission clock. A decision that is made twice, to measure it without
                compilation, is told twice.
            on_frame: told every frame, and the map that it has joined; on the same terms.
        """
        self.name, self.config = policy.name, getattr(policy, "config", None)
        self._policy, self._on_decision, self._on_frame = policy, on_decision, on_frame

    def init(self, camera: Camera, grid: OccupancyGrid, *, key: Array) -> Any:
        """The state before the first frame."""
        return self._policy.init(camera, grid, key=key)

    def observe(self, state: Any, map_state: MapState, frame: Frame) -> Any:
        """Takes note of a frame."""
        after = self._policy.observe(state, map_state, frame)
        self._on_frame(map_state, frame)
        return after

    def decide(
        self,
        state: Any,
        map_state: MapState,
        grid: OccupancyGrid,
        T_world_camera: np.ndarray,
        *,
        key: Array,
    ) -> tuple[Decision | None, Any, PlanInfo]:
        """The next view."""
        answer = self._policy.decide(state, map_state, grid, T_world_camera, key=key)
        if answer[0] is not None:
            self._on_decision(answer[0], grid)
        return answer

    def follow(
        self,
        state: Any,
        map_state: MapState,
        grid: OccupancyGrid,
        T_world_camera: np.ndarray,
        waypoints: np.ndarray,
    ) -> Any:
        """Takes note of a path that another policy chose."""
        return self._policy.follow(state, map_state, grid, T_world_camera, waypoints)


@dataclass(frozen=True)
class _RecordedWorld:
    """A run as a world without pictures: they are read back instead."""

    run: Run

    @property
    def camera(self) -> Camera:
        return self.run.camera

    @property
    def bounds(self) -> np.ndarray:
        return np.asarray(self.run.header.bounds, dtype=np.float64)

    @property
    def start_pose(self) -> np.ndarray:
        return np.asarray(self.run.rows[0].pose, dtype=np.float64)

    def render(self, T_world_camera: np.ndarray) -> Frame:
        raise RunError(self.run.path, "a recorded run has no pictures but its frames")


def decide_again(
    run: Run, policy: Policy, config: ExplorationConfig
) -> Iterator[tuple[int, Offer | None]]:
    """What was on offer at every view of a run, in order; takes as long as planning took.

    Args:
        run: the run, with at least one view; not a merged one.
        policy: the run's own.
        config: the run's own.

    Yields:
        The number of a view and the candidates that it was chosen from; None for the first view,
        and for views that a fork took over from another run.

    Raises:
        RunError: the policy decides otherwise today, a frame is missing, or the run was merged.
    """
    check_decided_alone(run)
    decided_from = int((run.header.parent or {}).get("decided_from", 0))
    decisions: list[Decision] = []
    init_key, key = jax.random.split(jax.random.key(run.header.seed))
    mission = Mission(
        GuardedSimulator(_RecordedWorld(run)),
        WatchedPolicy(policy, lambda decision, grid: decisions.append(decision)),
        parse_budget(run.header.budget),
        key,
        config,
        make_clock("model"),
    )
    try:
        state = start_state(mission, init_key)
    except ValueError as error:
        raise RunError(run.path, str(error)) from None
    state = dataclasses.replace(state, T_world_camera=np.asarray(run.rows[0].pose, np.float64))
    for row in run.rows:
        decisions.clear()
        decide = row.step >= decided_from
        state = relive(state, mission, row, run.frame(row.step), decides=decide)
        if not decisions or row.choice is None:
            yield row.step, None
            continue
        if not np.allclose(decisions[-1].T_world_camera, row.choice.pose, atol=1e-4):
            raise RunError(
                run.path,
                f"the policy {policy.name!r} decides otherwise today than it did at view "
                f"{row.step}: the run was recorded by another version, or on another machine",
            )
        yield row.step, offer_of(decisions[-1])
