"""A policy that runs a program: frames go to its input, and the next view is read from its output.

The program gets the same choice as a policy of this package: reachable candidates with the paths to
them, and the coarse grid. It replies with one of them, or with its own view, which must be
reachable, too.

Shape symbols: n frames; H W image size; X Y Z cells; C candidates.
"""

import itertools
import operator
import time
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from r3jax.errors import InputError
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.candidates import (
    Candidates,
    candidates_along,
    host_generator,
    path_lengths,
    random_views,
)
from r3jax.planning.config import PlannerConfig
from r3jax.planning.decide import (
    Drawn,
    PlannerState,
    Rule,
    Scored,
    decide,
    initial_state,
    look_round,
    with_path,
)
from r3jax.planning.policies.foreign.commands import COMMAND
from r3jax.planning.policies.foreign.messages import Message
from r3jax.planning.policies.foreign.program import Program
from r3jax.planning.policy import Decision, PlanInfo, PolicyError, Situation
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.json_text import check_type

PROTOCOL = 1
"""Version of the protocol."""

_SAME_PLACE = 1e-6
"""Positions closer than this are equal [m]."""


@dataclass(frozen=True)
class ForeignConfig(PlannerConfig):
    """Limits of a program, and settings of the candidates."""

    command: str = ""
    """Program and arguments."""

    answer_seconds: float = 120.0
    """Time limit for a reply [s]."""

    memory: float = 8.0
    """Memory limit for the program and its child processes [GiB]; 0: none."""

    def __post_init__(self) -> None:
        """Refuses invalid settings."""
        super().__post_init__()
        for name in ("answer_seconds", "memory"):
            if not 0.0 <= getattr(self, name) < 1e6:
                raise InputError(f"{name} must be a number >= 0, got {getattr(self, name)}")


@dataclass
class _Session:
    """A running program and the messages exchanged with it: the only mutable state here."""

    program: Program

    frames: dict[int, Frame] = field(default_factory=dict[int, Frame])
    """Frames not sent yet, by number."""

    answers: dict[int, tuple[Message, float]] = field(
        default_factory=dict[int, tuple[Message, float]]
    )
    """Its last reply and the time that it took [s], by the number of frames before it."""

    shown: int = 0
    """Number of frames sent."""


@dataclass(frozen=True)
class Foreign:
    """Runs an external program: exec:COMMAND."""

    config: ForeignConfig = field(default_factory=ForeignConfig)

    _sessions: dict[int, _Session] = field(
        default_factory=dict[int, _Session], compare=False, repr=False
    )

    name = "exec"
    source = "the program itself"
    Config = ForeignConfig

    def __post_init__(self) -> None:
        """Takes the command into the name."""
        object.__setattr__(self, "name", COMMAND + self.config.command)

    def init(self, camera: Camera, grid: OccupancyGrid, *, key: Array) -> PlannerState:
        """Starts the program and sends `hello`.

        Raises:
            PolicyError: it cannot be started, or does not reply.
        """
        session = _Session(Program(self.config.command, self.config.memory))
        # By number, in the state: one policy may plan for several cameras.
        number = next(n for n in itertools.count() if n not in self._sessions)
        self._sessions[number] = session
        answer = session.program.ask(self._hello(camera, grid, key), self.config.answer_seconds)
        if answer.kind != "hello" or answer.fields.get("protocol") != PROTOCOL:
            raise self._refused(
                session, f"answered `hello` with {answer.kind!r:.80}, protocol "
                f"{answer.fields.get('protocol')!r:.20}: this r3jax speaks protocol {PROTOCOL}"
            )  # fmt: skip
        memory = np.array([number, 0], dtype=np.int64)
        return initial_state(camera, grid, memory, self.config.motion)

    def _hello(self, camera: Camera, grid: OccupancyGrid, key: Array) -> Message:
        """Builds the message with all that holds for the whole run."""
        origin, size = np.asarray(grid.origin, np.float64), float(grid.cell_size)
        far = origin + size * np.asarray(grid.log_odds.shape)
        lens = {name: float(getattr(camera, name)) for name in ("fx", "fy", "cx", "cy")}
        return Message(
            "hello",
            {
                "protocol": PROTOCOL,
                "seed": _seed(key),
                "camera": {"width": camera.width, "height": camera.height, **lens},
                "max_range": float(self.config.scoring.max_range),
                "bounds": [origin.tolist(), far.tolist()],
                "cell_size": size,
                "safety_margin": self.config.safety_margin,
                "motion": asdict(self.config.motion),
            },
        )

    def observe(self, state: PlannerState, map_state: MapState, frame: Frame) -> PlannerState:
        """Stores the frame for the next request."""
        del map_state
        session, seen = self._session(state.memory)
        # By number: repeating a call, for timing, changes nothing.
        session.frames[seen] = frame
        return replace(state, memory=state.memory + np.array([0, 1]))

    def decide(
        self,
        state: PlannerState,
        map_state: MapState,
        grid: OccupancyGrid,
        T_world_camera: np.ndarray,
        *,
        key: Array,
    ) -> tuple[Decision | None, PlannerState, PlanInfo]:
        """Lets the program choose a view, and plans the path to it.

        Raises:
            PolicyError: no reply, or an invalid one; the program has been stopped.
        """
        # As in other policies, the same key gives the same candidates.
        rule = Rule(self._draw, self._ask, operator.itemgetter("utility"))
        return decide(rule, (state, map_state, grid, T_world_camera), self.config, key=key)

    def _draw(self, situation: Situation, *, key: Array) -> Drawn:
        travel, grid = situation.travel, situation.scoring_grid
        return Drawn(random_views(travel, grid, self.config, key=key), situation.memory)

    def _ask(self, situation: Situation, candidates: Candidates, *, key: Array) -> Scored:
        """Sends the candidates; the utility is 1 for the chosen view, else 0.

        Raises:
            PolicyError: no reply, or an invalid one.
        """
        session, seen = self._session(situation.memory)
        offered = candidates.take(np.isfinite(_costs(candidates, situation)))
        if not len(offered.valid):
            return candidates, {"utility": np.zeros(len(candidates.valid))}
        question = Message("decide", {"view": seen, "seed": _seed(key)}, _shown(situation, offered))
        answer = self._answer(session, seen, question)
        try:
            _check_view(answer, seen)
            chosen = _view_of(answer, offered, situation)
        except ForeignFileError as error:
            raise self._refused(session, f"received the request for view {seen}: {error}") from None
        if chosen is None:
            nothing = replace(offered, valid=np.zeros_like(offered.valid))
            return nothing, {"utility": np.zeros(len(offered.valid))}
        views, best = chosen
        return views, {"utility": np.eye(len(views.valid))[best]}

    def follow(
        self,
        state: PlannerState,
        map_state: MapState,
        grid: OccupancyGrid,
        T_world_camera: np.ndarray,
        waypoints: np.ndarray,
    ) -> PlannerState:
        """Records the cells on the path; the program receives frames only."""
        state, situation = look_round(state, map_state, grid, T_world_camera, self.config)
        return with_path(state, situation.travel, waypoints)

    def close(self) -> None:
        """Stops the programs."""
        while self._sessions:
            _, session = self._sessions.popitem()
            session.program.close()

    def _session(self, memory: Any) -> tuple[_Session, int]:
        """Finds the session of a memory, and its number of observed frames.

        Raises:
            PolicyError: it has ended.
        """
        number, seen = (int(value) for value in np.asarray(memory))
        if number not in self._sessions:
            raise PolicyError(f"the program {self.config.command!r} has ended")
        return self._sessions[number], seen

    def _answer(self, session: _Session, seen: int, question: Message) -> Message:
        """Sends a request with all frames not sent yet; repeated requests return the cached reply.

        Raises:
            PolicyError: no reply, or a request about an earlier state.
        """
        if seen in session.answers:
            answer, seconds = session.answers[seen]
            # Requested again, for timing without compilation: it takes as long as before.
            time.sleep(seconds)
            return answer
        numbers = sorted(number for number in session.frames if number < seen)
        # An earlier or a stored state: the program has seen more or fewer frames.
        if seen < session.shown or numbers != list(range(session.shown, seen)):
            raise PolicyError(
                f"the program {self.config.command!r} has seen {session.shown} frames and cannot "
                f"go to view {seen} from there: start a new run"
            )
        question.arrays.update(_images([session.frames[number] for number in numbers]))
        begin = time.perf_counter()
        answer = session.program.ask(question, self.config.answer_seconds)
        session.frames = {n: frame for n, frame in session.frames.items() if n >= seen}
        session.shown = seen
        session.answers = {seen: (answer, time.perf_counter() - begin)}
        return answer

    def _refused(self, session: _Session, reason: str) -> PolicyError:
        """Stops the program, and returns an error for its invalid reply."""
        session.program.close()
        return PolicyError(f"the program {self.config.command!r} {reason}")


def _seed(key: Array) -> int:
    """Derives a seed from a key, for the random numbers of a program."""
    return int(host_generator(key).integers(1 << 31))


def _costs(candidates: Candidates, situation: Situation) -> np.ndarray:
    """Computes the costs of the paths to views, turns included, [C] [m]."""
    lengths = path_lengths(situation.travel, candidates)
    return situation.limits.path_costs(lengths, candidates.direction)


def _images(frames: list[Frame]) -> dict[str, np.ndarray]:
    """Stacks frames in arrays: color [n, H, W, 3], depth [n, H, W] [m], poses [n, 4, 4]."""
    if not frames:
        return {}
    stacked = lambda name: np.stack([np.asarray(getattr(f, name), np.float32) for f in frames])
    return {
        "rgb": np.rint(stacked("rgb") * np.float32(255.0)).astype(np.uint8),
        "depth": stacked("depth"),
        "T_world_camera": stacked("T_world_camera"),
    }


def _shown(situation: Situation, offered: Candidates) -> dict[str, np.ndarray]:
    """Collects the camera's pose, the candidates, and the known space."""
    free, occupied = np.asarray(situation.grid.free), np.asarray(situation.grid.occupied)
    travel = situation.travel
    return {
        "here": situation.limits.T_world_camera,
        "position": offered.position,
        "direction": offered.direction,
        "path": _costs(offered, situation),
        "cells": free.astype(np.uint8) + np.uint8(2) * occupied.astype(np.uint8),
        "stops": (travel.goals & travel.safe).astype(np.uint8),
    }


def _check_view(answer: Message, seen: int) -> None:
    """Refuses a reply to another request: one extra message would shift all later ones.

    Raises:
        ForeignFileError: it names another view, or none.
    """
    view: Any = answer.fields.get("view")
    if type(view) is not int or view != seen:
        named = f"is for view {view!r:.20}" if "view" in answer.fields else "is missing `view`"
        raise ForeignFileError(
            f"its reply {named}: repeat the request's `view`, and send one message per request"
        )


def _view_of(
    answer: Message, offered: Candidates, situation: Situation
) -> tuple[Candidates, int] | None:
    """Adds the program's view to the candidates, and returns its number; None: no view.

    Raises:
        ForeignFileError: an invalid reply, or a view that cannot be taken; says why.
    """
    if answer.kind == "done":
        return None
    if answer.kind == "candidate":
        index: Any = answer.fields.get("index")
        check_type("index", index, int)
        if not 0 <= index < len(offered.valid):
            raise ForeignFileError(
                f"there is no candidate {index}, there are 0 to {len(offered.valid) - 1}"
            )
        return offered, index
    if answer.kind != "view":
        raise ForeignFileError(
            f"{answer.kind!r:.80} is not a valid reply: send `candidate`, `view` or `done`"
        )
    travel = situation.travel
    own = situation.limits.project_to_feasible(
        candidates_along(*(_point(answer, name)[None] for name in ("position", "direction")))
    )
    position = own.position[0]
    cell = travel.cell_of(position)
    is_here = bool(np.abs(position - travel.start).max() <= _SAME_PLACE)
    may_stop = travel.contains(cell) and travel.goals[cell] and travel.safe[cell]
    if not (is_here or may_stop) or not np.isfinite(_costs(own, situation)).all():
        raise ForeignFileError(
            f"the robot cannot go to {position.round(3).tolist()}: take a candidate, or stay in "
            "the cells of `stops`, which known free space leads to"
        )
    both = jax.tree.map(lambda *rows: np.concatenate(rows), offered, own)
    return both, len(offered.valid)


def _point(answer: Message, name: str) -> np.ndarray:
    """Reads three finite numbers of a reply; a direction must not be 0.

    Raises:
        ForeignFileError: they are not there.
    """
    value = answer.fields.get(name)
    check_type(name, value, list[float])
    point = np.asarray(value, dtype=np.float64)
    if point.shape != (3,):
        raise ForeignFileError(f"`{name}` must be three numbers, got {point.shape[0]}")
    length = float(np.linalg.norm(point))
    if name == "direction" and not 1e-6 < length < 1e6:
        raise ForeignFileError(f"`direction` has the length {length:g}: give a unit vector")
    return point
