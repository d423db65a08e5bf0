"""A run for the viewer: recorded, or in progress.

The map and the grid of a recorded run after any of its views are rebuilt from the frames, one after
the other. Some states on the path are kept, as many as fit in a given memory and evenly spaced, so
that any view is a few frames away from one.

The trace keeps the utilities of the best candidates, not where they were. Policies are pure, so
the same state and key give the same candidates: a run is decided again for them, and whether they
are the same is checked against the trace.
"""

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from r3jax.exploration.config import ExplorationConfig, parse_budget
from r3jax.exploration.guard import GuardedSimulator
from r3jax.exploration.state import Mission, model_clock
from r3jax.exploration.step import relive, start_state
from r3jax.exploration.taken_views import StepRow, TakenView
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.planner import Planner, first_map, take_in
from r3jax.planning.policy import Decision, Policy
from r3jax.runs.header import RunError, RunHeader
from r3jax.runs.reader import Run
from r3jax.runs.replay import (
    Reason,
    check_decided_alone,
    explain_run,
    first_planner,
    stored_planner,
)
from r3jax.runs.settings import config_of
from r3jax.scoring.config import ScoringConfig


@dataclass(frozen=True)
class Offer:
    """The candidates of one decision."""

    poses: np.ndarray
    """`T_world_camera`, [C, 4, 4]."""

    utilities: dict[str, np.ndarray]
    """Per candidate, [C] each; `total` and `path` always."""

    chosen: int
    """Index of the chosen one."""


def offer_of(decision: Decision) -> Offer:
    """Returns the candidates of a decision, and which of them was chosen."""
    gap = np.abs(decision.candidates - decision.T_world_camera).max(axis=(1, 2))
    return Offer(decision.candidates, decision.utilities, int(np.argmin(gap)))


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
    """Repeats the decisions of a run and yields the candidates at every view, in order.

    This takes as long as planning took.

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


MEMORY = 128 << 20
"""Memory for stored states [bytes]."""


@dataclass(frozen=True)
class Moment:
    """Map and grid after a view."""

    step: int
    """Number of the view; -1 before the first."""

    planner: Planner
    """Holds the map and the grid."""

    @functools.cached_property
    def map_state(self) -> MapState:
        """The whole map."""
        return self.planner.whole_map

    @functools.cached_property
    def grid(self) -> OccupancyGrid:
        """The whole grid."""
        return self.planner.whole_grid

    @property
    def nbytes(self) -> int:
        """Memory of its arrays [bytes]."""
        far = self.planner.far
        at_hand = jax.tree.leaves((self.planner.map_state, self.planner.grid))
        return sum(x.nbytes for x in at_hand) + (0 if far is None else far.tiles.nbytes)


def why_no_choice(row: StepRow) -> str:
    """Explains why no decision is recorded with a view."""
    if row.captured:
        return "captured while moving"
    if row.begins_run:
        return "the start: nothing was chosen"
    return "taken on arrival: the decision to come here is shown with the first frame of this path"


class Timeline:
    """The states of a run. For one thread at a time."""

    def __init__(self, run: Run, memory: int = MEMORY):
        """Prepares the state before the first view; reads no frame.

        Args:
            run: with at least one view.
            memory: what kept states may take [bytes]; two are always kept.

        Raises:
            RunError: settings that cannot work, or a run without a view.
        """
        self.run = run
        first = first_planner([run])
        stored = _stored(run, first)
        if stored is not None:
            # Rows enough for the last state from the start on: what works on maps compiles once.
            config = replace(first.config, capacity=stored.planner.map_state.capacity)
            first = replace(first, map_state=first_map(config), config=config)
        self._start = self._reached = Moment(-1, first)
        kept = max(2, memory // self._start.nbytes)
        self.stride = math.ceil(len(run.rows) / kept)
        """Views from one kept state to the next."""
        self._kept: dict[int, Moment] = {}
        self._stored = self._shown = stored

    def at(self, step: int) -> Moment:
        """Returns the state after view `step`.

        Raises:
            IndexError: the run has no such view.
            RunError: a frame is missing, broken, or not the one that was recorded.
        """
        for _ in self.replay(step):
            pass
        return self._before(step)

    def replay(self, step: int) -> Iterator[tuple[int, int]]:
        """Goes to the state after view `step`, one frame per iteration.

        Yields:
            Before each frame, how many have been replayed and how many there are to replay.

        Raises:
            IndexError, RunError: as `at`.
        """
        if not 0 <= step < len(self.run.rows):
            raise IndexError(f"the run has views 0 to {len(self.run.rows) - 1}, not {step}")
        moment = self._before(step)
        total = step - moment.step
        for done in range(total):
            yield done, total
            moment = self._shown = self._after(moment)
        self._shown = moment

    def follow(self) -> Iterator[Moment]:
        """Yields every state in order, lazily; `at` may be called in between.

        Raises:
            RunError: as `at`.
        """
        moment = self._start
        while moment.step < len(self.run.rows) - 1:
            moment = self._after(moment)
            yield moment

    def _before(self, step: int) -> Moment:
        """Returns the latest known state that is not later than `step`."""
        known = [self._start, self._reached, *self._kept.values(), self._shown, self._stored]
        return max((m for m in known if m is not None and m.step <= step), key=lambda m: m.step)

    def _after(self, moment: Moment) -> Moment:
        """Computes the state one view later, and stores it for later use."""
        frame = self.run.frame(moment.step + 1)
        after = Moment(moment.step + 1, take_in(moment.planner, frame))
        if after.step % self.stride == 0:
            self._kept[after.step] = after
        if after.step > self._reached.step:
            self._reached = after
        return after


def _stored(run: Run, first: Planner) -> Moment | None:
    """Reads the last view's state from its checkpoint; returns None if it must be replayed."""
    try:
        step, planner = stored_planner(run)
    except RunError:
        return None
    state, config = planner.map_state, first.config
    is_ours = (
        step == len(run.rows) - 1
        and state.key.shape == (2, state.capacity)
        and state.mean.shape == (3, state.capacity)
        and state.capacity & (state.capacity - 1) == 0
        and float(state.voxel_size) == np.float32(config.voxel_size)
        and planner.grid.log_odds.shape == first.grid.log_odds.shape
    )
    return Moment(step, planner) if is_ours else None


_THUMBNAIL = 256
"""Longer side of the pictures that a live story keeps [px], about."""

_OFFERS_KEPT = 200
"""Decisions whose candidates are kept: 100 of them take 7 kB."""


_WORKING = "is being computed …"


@runtime_checkable
class Story(Protocol):
    """Views in order, what they showed, and what was known after them."""

    @property
    def camera(self) -> Camera:
        """The camera of every view."""
        ...

    @property
    def rows(self) -> Sequence[StepRow]:
        """What the trace says of the views so far."""
        ...

    @property
    def is_live(self) -> bool:
        """Whether there may be more views later."""
        ...

    def image(self, step: int) -> np.ndarray:
        """Returns the picture of a view, [H, W, 3] uint8."""
        ...

    def moment(self, step: int) -> Moment:
        """Returns the state after a view; for the worker's thread only."""
        ...

    def replay(self, step: int) -> Iterator[tuple[int, int]]:
        """Prepares `moment` bit by bit: yields how many bits are done, and how many there are."""
        ...

    def advance(self) -> bool:
        """Prepares for later questions; False when there is nothing to prepare."""
        ...

    def offer(self, step: int) -> Offer | None:
        """Returns the candidates that a view was chosen from, or None if they are not known."""
        ...

    def reason(self, step: int) -> Reason | str:
        """Returns what a view promised when it was chosen, or why that is not known."""
        ...


class RecordedStory:
    """A run on disk."""

    is_live = False

    def __init__(self, run: Run):
        """Opens it.

        Raises:
            RunError: as `Timeline`.
        """
        self._run, self._timeline = run, Timeline(run)
        self._reasons: list[Reason | None] = []
        self._problem = ""
        self._explaining = self._explain()

    @property
    def camera(self) -> Camera:
        """The camera of every view."""
        return self._run.camera

    @property
    def rows(self) -> Sequence[StepRow]:
        """What the trace says of the views."""
        return self._run.rows

    def image(self, step: int) -> np.ndarray:
        """Returns the picture of a view, [H, W, 3] uint8.

        Raises:
            RunError: it is missing or broken.
        """
        return _recorded_image(self._run, step)

    def moment(self, step: int) -> Moment:
        """Returns the state after a view."""
        return self._timeline.at(step)

    def replay(self, step: int) -> Iterator[tuple[int, int]]:
        """Replays the frames that lead to a view."""
        return self._timeline.replay(step)

    def advance(self) -> bool:
        """Replays one view more than ever before, and finds out why the next one was taken.

        Raises:
            RunError: a frame is missing or broken, or a setting of the policy is not known.
        """
        try:
            self._reasons.append(next(self._explaining))
        except StopIteration:
            return False
        except RunError as error:
            self._problem = str(error)
            raise
        return True

    def _explain(self) -> Iterator[Reason | None]:
        """Replays the run and iterates over the reasons of all views, in order.

        Where decisions were not made on this map alone, all reasons are None.
        """
        moments = self._timeline.follow()
        if self._run.header.is_merged:
            self._problem = "merged from runs that decided each on a map of its own"
            return (None for _ in moments)
        if self._run.header.is_of_team:
            self._problem = "decided on what the others of a team had seen, too"
            return (None for _ in moments)
        if config_of(self._run).tiles:
            self._problem = "in the report: a page of a run with tiles does not show it by voxel"
            return (None for _ in moments)
        return explain_run(self._run, (m.planner for m in moments))

    def offer(self, step: int) -> Offer | None:
        """Returns None: the trace does not contain the candidates."""
        del step
        return None

    def reason(self, step: int) -> Reason | str:
        """Returns what a view promised when it was chosen, or why that is not known.

        It is known once the views before have been replayed.
        """
        if self._run.rows[step].choice is None:
            return why_no_choice(self._run.rows[step])
        reason = self._reasons[step] if step < len(self._reasons) else None
        return reason or self._problem or _WORKING


class LiveStory:
    """A run in progress. Only the newest state of the map is stored."""

    is_live = True

    def __init__(
        self,
        camera: Camera,
        earlier: Run | None = None,
    ):
        """Begins with the views that were recorded before, if any, without their map.

        Args:
            camera: of every view.
            earlier: recording of a resumed run.
        """
        self._camera, self._earlier = camera, earlier
        self._rows: list[StepRow] = [] if earlier is None else list(earlier.rows)
        self._images: dict[int, np.ndarray] = {}
        self._offers: dict[int, Offer] = {}
        self._moment: Moment | None = None

    @property
    def camera(self) -> Camera:
        """The camera of every view."""
        return self._camera

    @property
    def rows(self) -> Sequence[StepRow]:
        """What the trace says of the views so far."""
        return self._rows

    def add(self, view: TakenView, planner: Planner) -> None:
        """Takes in one view more.

        Args:
            view: the view.
            planner: has seen it.
        """
        image = np.rint(np.asarray(view.frame.rgb) * 255.0).astype(np.uint8)
        step = max(1, max(image.shape[:2]) // _THUMBNAIL)
        self._images[view.row.step] = np.ascontiguousarray(image[::step, ::step])
        if view.decision is not None:
            self._offers[view.row.step] = offer_of(view.decision)
        self._offers.pop(view.row.step - _OFFERS_KEPT, None)
        self._moment = Moment(view.row.step, planner)
        self._rows.append(view.row)

    def image(self, step: int) -> np.ndarray:
        """Returns the picture of a view, made smaller if it is new, [h, w, 3] uint8.

        Raises:
            RunError: one that was recorded before is missing or broken.
        """
        if step in self._images or self._earlier is None:
            return self._images[step]
        return _recorded_image(self._earlier, step)

    def moment(self, step: int) -> Moment:
        """Returns the current state: earlier maps are not stored.

        Raises:
            LookupError: before the first view.
        """
        del step
        if self._moment is None:
            raise LookupError("there is no view yet")
        return self._moment

    def replay(self, step: int) -> Iterator[tuple[int, int]]:
        """Returns an empty iterator: the current state needs no replay."""
        del step
        return iter(())

    def advance(self) -> bool:
        """Returns False: there is nothing to prepare."""
        return False

    def offer(self, step: int) -> Offer | None:
        """Returns the candidates that a view was chosen from."""
        return self._offers.get(step)

    def reason(self, step: int) -> Reason | str:
        """Returns a text instead of a reason: the map that a view was chosen on is not stored."""
        del step
        return "known once the run is over and opened by `r3jax view`"


def _recorded_image(run: Run, step: int) -> np.ndarray:
    return run.images(step)[0]


_ABOVE_HEADS = 0.6


_BELOW_CEILING = 0.3


def scoring_of(header: RunHeader) -> ScoringConfig:
    """Returns the settings of the scores, with the range of the run's sensor."""
    max_range = float(header.config.get("max_range", 5.0))
    return ScoringConfig(max_range=jnp.asarray(max_range, dtype=jnp.float32))


def title_of(header: RunHeader) -> str:
    """Names a run by its policy and its scene; of a file, without its folders."""
    scene = str(header.scene.get("name", "")).rpartition("/")[2]
    return f"{header.policy.get('name', '')} in {scene}"


def cut_height(rows: Sequence[StepRow], points: np.ndarray) -> float:
    """Returns the height [m] above which nothing is drawn, so that the place is open from above.

    Args:
        rows: of the trace, at least one: the cameras stay in view.
        points: centers of blocks [n, 3] [m].
    """
    typical = float(np.median([row.pose[2, 3] for row in rows])) + _ABOVE_HEADS
    if len(points) == 0:
        return typical
    # Below the ceiling in any case, even where the cameras flew right under it.
    return min(typical, float(np.percentile(points[:, 2], 99.5)) - _BELOW_CEILING)
