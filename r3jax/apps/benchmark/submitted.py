"""Submissions as cells of a benchmark: checked, rendered again, then trained like all others."""

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from r3jax.apps.benchmark.cells import OWN_OF_LOOP, Cell, Conditions
from r3jax.apps.benchmark.plan import Request, prepare_scene
from r3jax.errors import InputError
from r3jax.exploration.config import ExplorationConfig, format_budget, parse_budget
from r3jax.exploration.coverage import measure_coverage, view_renderability
from r3jax.exploration.guard import check_world
from r3jax.exploration.state import model_clock
from r3jax.exploration.taken_views import Choice, StepRow, frame_hash, stored_form
from r3jax.files import make_folder
from r3jax.formats.submissions import (
    Submission,
    SubmittedFrame,
    content_hash,
    read_submission,
    write_submission,
)
from r3jax.geometry.cameras import Camera, angle_between
from r3jax.planning.planner import add_frame, first_grid, first_map
from r3jax.planning.robot.limits import begin_at
from r3jax.planning.robot.motion import MOTIONS
from r3jax.runs.header import RunHeader, camera_fields
from r3jax.runs.stored_states import map_tables
from r3jax.runs.writer import RunWriter
from r3jax.simulators.base import Simulator
from r3jax.simulators.free_space import GroundTruth
from r3jax.simulators.scenes.registry import scene_hash

FOLDER = "submissions"
"""Folder of a benchmark for the submissions that it judges."""

CLEARANCE = 0.15
"""Least distance of the camera's path to every surface [m]. Paths of policies keep a cell of 0.2 m
between them and what is not known to be free; a surface may reach 0.05 m into a cell before a hit
marks it. Glass that the depth sensor does not see is left out, as no policy can know of it."""

_MAX_LENGTH = 20_000.0
"""Of all paths together [m]; eleven hours of flight at the speed of the protocol."""

_SAME_PLACE = 2e-3
"""Places this close are one [m]."""

_SAME_ANGLE = 0.1
"""Angles this close are one [deg]."""


@dataclass(frozen=True)
class Problem:
    """A rule that a submission breaks."""

    frame: int | None
    """Number of the frame; None: of the terms, in the first line."""

    text: str
    """What is wrong, and what to do."""

    def __str__(self) -> str:
        """Says where, then what."""
        where = "line 1" if self.frame is None else f"line {self.frame + 2}, frame {self.frame}"
        return f"{where}: {self.text}"


def problems_of(submission: Submission) -> list[Problem]:
    """Lists the rules of the protocol that a submission breaks, which prevent its evaluation."""
    try:
        if len(submission.frames) < 2:
            raise InputError("a model is trained on two frames at least, and there is one")
        submission.config.check_scales()
        _ = conditions_of(submission, Conditions(train_resolution=16)).train_config(submission.seed)
        simulator = submission.opened.open()
        check_world(simulator.bounds, submission.config.cell_size, "`exploration.cell_size`")
        return check_submission(submission, simulator)
    except (ValueError, ImportError) as error:
        return [Problem(None, str(error))]


def check_submission(submission: Submission, simulator: Simulator) -> list[Problem]:
    """Lists the rules that a submission breaks, in the order of its lines.

    The rules bound what a camera can do: the scene has the stated hash, the path begins at its
    start and keeps clear of every surface, the clock allows enough time, and all frames arrive
    within the budget. How a policy chooses its views is not checked.

    Args:
        submission: as it was read.
        simulator: its scene, opened as it says.

    Raises:
        ValueError: the simulator has no mesh to check paths against; a budget, or a start, that
            cannot be.
    """
    found = scene_hash(simulator)
    if found != submission.scene["hash"]:
        told = (
            f"the scene {submission.scene['name']} has the hash {found[:12]} here, "
            f"{submission.scene['hash'][:12]} in the submission: use the file of the scene, and "
            "the r3jax, that the views were chosen with"
        )
        return [Problem(None, told)]
    paths = submission.paths()
    if not (metres := sum(map(_length, paths))) <= _MAX_LENGTH:
        told = f"its paths are {metres:.3g} m long, more than {_MAX_LENGTH:g} m"
        return [Problem(None, f"{told}: are the positions in meters? Submit a shorter run")]
    # All paths at once: one by one, ten thousand frames would take a minute.
    rooms, places = GroundTruth(simulator).room_along(paths, CLEARANCE)
    problems = list(_check_frames(submission, begin_at(submission.robot, simulator.start_pose)))
    for number in np.flatnonzero(rooms < CLEARANCE):
        at = places[number].round(3).tolist()
        told = f"its path is {rooms[number]:.3f} m from a surface at {at}: keep {CLEARANCE} m"
        problems.append(Problem(int(number), told))
    return sorted(problems, key=lambda problem: problem.frame or 0)


def _check_frames(submission: Submission, start: np.ndarray) -> Iterator[Problem]:
    """Yields the rules that frames break, apart from the distance to surfaces.

    Args:
        submission: as it was read.
        start: where its scene is to be begun, [4, 4].
    """
    config, budget = submission.config, parse_budget(submission.budget)
    speed = submission.robot.speed or config.speed
    costs = model_clock(config).costs if config.clock == "model" else {}
    longest = config.piece_at(speed) * (1.0 - 1e-4)
    before, pose, metres, views = None, start, 0.0, 0
    captured, way = 0, 0.0
    for frame, path in zip(submission.frames, submission.paths(), strict=True):
        length = _length(path)
        flown = metres + length if frame.metres is None else frame.metres
        needed, mapping = max(flown - metres, length) / speed, costs.get("mapping", 0.0)
        if not (before is None or before.captured):  # what follows a capture was decided before it
            needed += costs.get("reconsidering" if config.plan_while_moving else "planning", 0.0)
        arrival = frame.seconds - frame.mapping
        taken = arrival - (0.0 if before is None else before.seconds)
        gap = np.linalg.norm(path[[0, -1]] - np.stack([pose[:3, 3], frame.position]), axis=1).max()
        turned = math.degrees(angle_between(frame.pose.astype(np.float64), pose))
        # A frame captured while moving belongs to the view that it was captured before.
        spent: dict[str, Any] = {
            "views": views + 1, "frames": frame.frame + 1, "seconds": arrival, "metres": flown,
        }  # fmt: skip
        # The loop cuts a path into the fewest equal pieces that are not too long, and captures a
        # frame between two of them. A budget of views does not count these.
        captured, way = captured + frame.captured, way + length
        rules = {
            f"`metres` grows by {flown - metres:.4f}, the path has {length:.4f} m: count all of it":
                flown - metres < _less(length),
            f"`seconds` leaves {taken:.4f} s for deciding and {length:.3f} m at {speed:g} m/s, "
            f"which take {needed:.4f} s: count all of them": taken < _less(needed),
            f"`mapping` is {frame.mapping:g} s, it takes {mapping:g} s or more":
                frame.mapping < _less(mapping),
            f"its path ends {gap:.3f} m from a view, turned by {turned:.2f} degrees: begin at the "
            "scene's start, and lead from view to view":
                gap > _SAME_PLACE or (before is None and turned > _SAME_ANGLE),
            format_budget(f"it takes {spent[budget.unit]:g} {budget.unit}, beyond the budget "
                          f"{budget}: end before it"): not budget.allows(**spent),
            f"{captured} frames are captured on {way:.3f} m: at the most one on {longest:.3g} m, "
            "by `capture_every` or `capture_rate` in line 1":
                captured > 0 and captured >= way / longest + frame.captured,
        }  # fmt: skip
        yield from (Problem(frame.frame, told) for told, is_broken in rules.items() if is_broken)
        before, pose, metres = frame, frame.pose.astype(np.float64), flown
        if not frame.captured:
            captured, way, views = 0, 0.0, views + 1


def _length(path: np.ndarray) -> float:
    """Computes the length of a path [m]."""
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def _less(value: float) -> float:
    """Returns a length [m] or a time [s] less a tolerance for rounding."""
    return value * (1.0 - 1e-4) - 1e-4


def conditions_of(
    submission: Submission, base: Conditions, snapshots: tuple[str, ...] = ()
) -> Conditions:
    """Returns the terms of a submission's exploration, with the training and judging of `base`.

    Args:
        submission: gives budget, sensor, maps and clock.
        base: gives the rest.
        snapshots: where a model is trained; by default at the budget.

    Raises:
        ValueError: a camera that no benchmark has, or a setting that cannot work.
    """
    config = submission.config
    loop = {
        name: value for name, value in dataclasses.asdict(config).items() if name not in OWN_OF_LOOP
    }
    width, fov = _square(submission)
    return dataclasses.replace(
        base,
        budget=submission.budget,
        snapshots=snapshots,
        clock=config.clock,
        resolution=width,
        fov=fov,
        noise=submission.scene["noise"],
        max_range=config.max_range,
        voxel_size=config.voxel_size,
        cell_size=config.cell_size,
        map_capacity=config.capacity,
        loop=loop,
    )


def _square(submission: Submission) -> tuple[int, float]:
    """Returns the width [px] and field of view [degrees] of the square images of a benchmark."""
    camera = submission.camera
    width, half = int(camera["width"]), 0.5 * camera["width"]
    # As people write it: the focal length is stored in float32.
    fov = round(math.degrees(2.0 * math.atan(half / camera["fx"])), 4)
    if camera_fields(Camera.from_fov(width, width, fov)) != camera:
        raise InputError(
            "`camera`: the benchmark has square images and pixels with the principal point in the "
            f"middle, got {camera}"
        )
    return width, fov


def plan_submission(
    submission: Submission,
    base: Conditions,
    root: Path,
    *,
    snapshots: tuple[str, ...] = (),
    max_test_views: int | None = 120,
    on_stage: Callable[[str], None] = lambda stage: None,
) -> Cell:
    """Plans the cell of a submission; renders and stores its scene's test views.

    Args:
        submission: as it was read.
        base: how models are trained and judged.
        root: folder of the benchmark.
        snapshots: where a model is trained; by default at the budget.
        max_test_views: of the scene at most; None: all of the lattice.
        on_stage: told what happens now.

    Raises:
        ValueError: it breaks a rule; says which, and what to do.
        OSError: a folder that cannot be written.
    """
    on_stage(f"checking {submission.name}")
    if problems := problems_of(submission):
        more = f"; {len(problems) - 1} more: --check lists all" if len(problems) > 1 else ""
        raise InputError(f"{problems[0]}{more}")
    conditions = conditions_of(submission, base, snapshots)
    scene, settings = submission.scene, _settings_of(submission)
    opened: dict[str, Any] = {name: scene[name] for name in ("up", "scale", "cull_backfaces")}
    request = Request(
        (scene["name"],), (), (submission.seed,), conditions, max_test_views, settings, **opened
    )
    view_set = prepare_scene(request, scene["name"], root, on_stage)
    digest = content_hash(submission)
    make_folder(stored_submission(root, digest).parent)
    write_submission(stored_submission(root, digest), submission)
    return Cell(
        scene=scene["name"],
        scene_hash=scene["hash"],
        policy=submission.name,
        seed=submission.seed,
        conditions=conditions,
        test_views_hash=view_set.hash,
        num_test_views=len(view_set),
        settings=settings,
        submission=digest,
        **opened,
    )


def _settings_of(submission: Submission) -> dict[str, Any]:
    """Returns the settings that tables must show: the robot, unless it flies freely."""
    if submission.robot == MOTIONS["free"]:
        return {}
    names = [name for name, motion in MOTIONS.items() if motion == submission.robot]
    return {"motion": names[0] if names else submission.motion}


def stored_submission(root: Path, digest: str) -> Path:
    """Returns the path of a submission in a benchmark's folder, by the hash of its content."""
    return Path(root) / FOLDER / f"{digest[:16]}.jsonl"


def load_submission(root: Path, digest: str) -> Submission:
    """Reads a submission that a benchmark keeps.

    Raises:
        ValueError: it is gone or damaged.
    """
    path = stored_submission(root, digest)
    submission = read_submission(path)
    if content_hash(submission) != digest:
        raise InputError(f"{path} is not what was planned: start the benchmark again")
    return submission


def retake(
    submission: Submission,
    simulator: Simulator,
    config: ExplorationConfig,
    header: RunHeader,
    path: Path,
    on_frame: Callable[[int], None] = lambda frame: None,
) -> None:
    """Renders and maps the frames of a submission, and records them as a run.

    The noise of the sensor follows from the seed and the pose: the frames are those that the
    exploration saw, bit for bit, where the simulator computes as it did there.

    Args:
        submission: checked (`check_submission`).
        simulator: its scene, opened as it says.
        config: how frames join the map, and what is measured.
        header: of the run.
        path: its folder; a run that is there is replaced.
        on_frame: called with the number of every frame that is recorded.

    Raises:
        RunError: the folder holds something else, or cannot be written.
    """
    pose = begin_at(submission.robot, simulator.start_pose)
    map_state = first_map(config)
    grid = first_grid(np.asarray(simulator.bounds, np.float64), [pose], config)
    radians = metres = seconds = 0.0
    with RunWriter(path, header, overwrite=True) as recorder:
        paths = submission.paths()
        for frame, way, choice in zip(
            submission.frames, paths, _choices(submission.frames, paths), strict=True
        ):
            taken = stored_form(simulator.render(frame.pose.astype(np.float64)))
            arrival = view_renderability(map_state, taken.camera, taken.T_world_camera)
            map_state, grid = add_frame(map_state, grid, taken, config)
            radians += angle_between(pose, frame.pose.astype(np.float64))
            pose = frame.pose.astype(np.float64)
            metres = metres + _length(way) if frame.metres is None else frame.metres
            row = StepRow(
                step=frame.frame,
                pose=frame.pose,
                sha256=frame_hash(taken),
                choice=choice,
                seconds=frame.seconds,
                metres=metres,
                radians=radians,
                # Planning and flight are not told apart: a policy's own affair.
                charged={
                    "planning": 0.0,
                    "flight": frame.seconds - frame.mapping - seconds,
                    "mapping": frame.mapping,
                },
                coverage=measure_coverage(
                    map_state,
                    grid,
                    taken.camera,
                    arrival_renderability=arrival,
                    num_probes=config.num_probes,
                ),
                captured=frame.captured,
            )
            seconds = frame.seconds
            recorder.add(row, taken)
            on_frame(frame.frame)
        recorder.checkpoint(len(submission.frames) - 1, map_tables(map_state, grid), wait=True)
        recorder.finish(submission.outcome, "the frames of a submission, taken again")


def _choices(frames: Sequence[SubmittedFrame], paths: Sequence[np.ndarray]) -> list[Choice | None]:
    """Returns a choice for the first frame of the path to each view, else None.

    Only the path of the choice is known. As in a trace, it belongs to the first frame on the path.
    """
    choices: list[Choice | None] = [None] * len(frames)
    first = 1
    for last in range(1, len(frames)):
        if frames[last].captured and last + 1 < len(frames):
            continue  # captured while moving to a view
        pieces = [path[1:] for path in paths[first : last + 1]]
        whole = np.concatenate([paths[first][:1], *pieces])
        waypoints = whole.astype(np.float32)
        choices[first] = Choice(
            frames[last].pose, 0.0, waypoints, _length(whole), num_candidates=0, num_reachable=0
        )
        first = last + 1
    return choices
