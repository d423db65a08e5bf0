"""What a policy had on offer: as it decided, or decided again from the recorded frames.

The trace keeps the utilities of the best candidates, not where they were. Policies are pure, so
the same state and key give the same candidates; whether they do is checked against the trace.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import jax
import numpy as np

from r3jax.apps.viewer.color_maps import UTILITY_MAP, paint, spread
from r3jax.apps.viewer.overlays import frustum_segments
from r3jax.exploration.budget import parse_budget
from r3jax.exploration.clock import model_clock
from r3jax.exploration.config import ExplorationConfig
from r3jax.exploration.guard import GuardedSimulator
from r3jax.exploration.replay import check_decided_alone
from r3jax.exploration.state import Mission
from r3jax.exploration.step import relive, start_state
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.planning.policy import Decision, Policy
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
    init_key, key = jax.random.split(jax.random.key(run.header.seed))
    mission = Mission(
        GuardedSimulator(_RecordedWorld(run)),
        policy,
        parse_budget(run.header.budget),
        key,
        config,
        model_clock(config),
    )
    try:
        state = start_state(mission, init_key)
    except ValueError as error:
        raise RunError(run.path, str(error)) from None
    state = replace(state, T_world_camera=np.asarray(run.rows[0].pose, np.float64))
    for row in run.rows:
        decides = row.step >= decided_from
        state, decision = relive(state, mission, row, run.frame(row.step), decides=decides)
        if decision is None or row.choice is None:
            yield row.step, None
            continue
        if not np.allclose(decision.T_world_camera, row.choice.pose, atol=1e-4):
            raise RunError(
                run.path,
                f"the policy {policy.name!r} decides otherwise today than it did at view "
                f"{row.step}: the run was recorded by another version, or on another machine",
            )
        yield row.step, offer_of(decision)
