"""Takes the frames of a submission again: a run folder as the exploration itself leaves it."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from r3jax.exploration.config import ExplorationConfig
from r3jax.exploration.coverage import measure_coverage, view_renderability
from r3jax.exploration.taken_views import Choice, StepRow, frame_hash, stored_form
from r3jax.formats.submissions import Submission, SubmittedFrame
from r3jax.geometry.cameras import angle_between
from r3jax.mapping.state import empty_map
from r3jax.planning.planner import add_frame, first_grid
from r3jax.planning.robot.limits import begin_at
from r3jax.runs.header import RunHeader
from r3jax.runs.stored_states import map_tables
from r3jax.runs.writer import RunWriter
from r3jax.simulators.base import Simulator


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
        submission: checked (`submission_checks`).
        simulator: its scene, opened as it says.
        config: how frames join the map, and what is measured.
        header: of the run.
        path: its folder; a run that is there is replaced.
        on_frame: called with the number of every frame that is recorded.

    Raises:
        RunError: the folder holds something else, or cannot be written.
    """
    pose = begin_at(submission.robot, simulator.start_pose)
    map_state = empty_map(config.capacity, config.voxel_size, config.num_bins)
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
            length = float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())
            metres = metres + length if frame.metres is None else frame.metres
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
    """What is known of the choice of each view: the path to it; nothing was on offer.

    As in a trace, it stands with the first frame that was taken on the path.
    """
    choices: list[Choice | None] = [None] * len(frames)
    first = 1
    for last in range(1, len(frames)):
        if frames[last].captured and last + 1 < len(frames):
            continue  # on the way to a view
        pieces = [path[1:] for path in paths[first : last + 1]]
        whole = np.concatenate([paths[first][:1], *pieces])
        length = float(np.linalg.norm(np.diff(whole, axis=0), axis=1).sum())
        waypoints = whole.astype(np.float32)
        choices[first] = Choice(
            frames[last].pose, 0.0, waypoints, length, num_candidates=0, num_reachable=0
        )
        first = last + 1
    return choices
