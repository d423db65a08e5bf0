"""Frames that are taken again: the run that comes out flew where the submission says."""

import dataclasses

import numpy as np

from r3jax.apps.benchmark.retake import retake
from r3jax.exploration.config import ExplorationConfig
from r3jax.formats.submissions import SubmittedFrame
from r3jax.runs.header import camera_fields
from r3jax.runs.reader import read_run
from r3jax.runs.rows import paths_to
from tests.exploration.toys import BoxRoom
from tests.formats.test_submissions import make_submission
from tests.runs.runs import make_header

PLACES = [(1.2, 1.1), (1.6, 1.3), (1.6, 1.7), (2.0, 1.7), (2.0, 1.1), (1.8, 1.1)]
CORNERS = {1: (1.6, 1.1), 3: (1.6, 1.9), 4: (2.3, 1.4)}
"""Where the path to a frame bends."""

CAPTURED = (1, 2, 5)
"""Two on the way to the view 3, and one on a way that the budget cut off."""


def test_corners_between_frames_on_the_way_are_kept(tmp_path):
    room = BoxRoom()
    frames = tuple(frame(number, room.start_pose) for number in range(len(PLACES)))
    submission = dataclasses.replace(make_submission(), frames=frames)
    config = ExplorationConfig(clock="model", voxel_size=0.1, capacity=1 << 12, num_probes=1)
    header = make_header(camera=camera_fields(room.camera), bounds=room.bounds.tolist())
    retake(submission, room, config, header, tmp_path / "run")
    run = read_run(tmp_path / "run")
    flown = list(paths_to(run.rows))
    assert flown[0] is None
    for path, planned in zip(flown[1:], submission.paths()[1:], strict=True):
        np.testing.assert_allclose(path, planned, atol=1e-5)
    chosen = [row.choice is not None for row in run.rows]
    assert chosen == [False, True, False, False, True, True]  # with the first frame of each path
    assert [row.captured for row in run.rows] == [number in CAPTURED for number in range(6)]


def frame(number, start):
    """A frame of the flight above, at the height of the start."""
    pose = start.astype(np.float32)
    pose[:2, 3] = PLACES[number]
    path = None
    if number in CORNERS:
        ends = PLACES[number - 1], CORNERS[number], PLACES[number]
        path = np.array([[*end, pose[2, 3]] for end in ends], np.float32)
    return SubmittedFrame(number, pose, float(number), path=path, captured=number in CAPTURED)
