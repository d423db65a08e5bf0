"""Submissions: a run, its poses, and from these alone the same images and the same scores."""

import dataclasses
import math
import shutil

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from r3jax.apps.benchmark import run_cell as module
from r3jax.apps.benchmark.cells import Conditions, paths_of
from r3jax.apps.benchmark.record import read_records
from r3jax.apps.benchmark.run_cell import CellError, run_cell
from r3jax.apps.benchmark.submitted import (
    _check_frames,
    check_submission,
    conditions_of,
    problems_of,
    retake,
    stored_submission,
)
from r3jax.exploration.config import LEAST_PIECE, ExplorationConfig, parse_budget
from r3jax.exploration.loop import explore
from r3jax.exploration.taken_views import frame_hash, stored_form
from r3jax.formats.submissions import (
    SubmittedFrame,
    content_hash,
    read_submission,
    submission_of_run,
    write_submission,
)
from r3jax.geometry.cameras import Camera, pose_along
from r3jax.planning.registry import make_policy
from r3jax.planning.robot.motion import make_motion
from r3jax.runs.begin import begin_run
from r3jax.runs.header import RunError, camera_fields
from r3jax.runs.reader import read_run
from r3jax.runs.rows import paths_to
from r3jax.runs.settings import RunSettings, SceneSettings
from tests.apps.benchmark.tiny import CONDITIONS
from tests.exploration.toys import BoxRoom
from tests.formats.test_submissions import make_submission
from tests.runs.runs import make_header


@pytest.fixture(scope="module")
def submission(finished):
    """Of the exploration of the first finished cell."""
    root, cells = finished
    return submission_of_run(read_run(paths_of(root, cells[0]).run))


@pytest.fixture(scope="module")
def scene(submission):
    return submission.opened.open()


def submitted_cell(cell, submission, root):
    """The cell that judges a submission on the terms of another cell."""
    stored = stored_submission(root, content_hash(submission))
    stored.parent.mkdir(parents=True, exist_ok=True)
    write_submission(stored, submission)
    conditions = conditions_of(submission, cell.conditions, cell.conditions.snapshots)
    return dataclasses.replace(
        cell,
        policy=submission.name,
        conditions=conditions,
        settings={},
        submission=content_hash(submission),
    )


def test_the_poses_of_a_run_are_scored_as_the_run(finished, submission, tmp_path):
    root, cells = finished
    shutil.copytree(root / "test_views", tmp_path / "test_views")
    cell = submitted_cell(cells[0], submission, tmp_path)
    assert cell.conditions == cells[0].conditions
    run_cell(cell, tmp_path)
    mine, theirs = read_records(tmp_path), read_records(root, cells[:1])
    assert len(mine) == len(theirs) == 2
    for record, other in zip(mine, theirs, strict=True):
        assert record["policy"] == "random (submitted)"
        assert record["submission"]["same_images"] == record["submission"]["known_images"] == 3
        for name in ("metrics", "views", "exploration", "sensing", "training", "scene_hash"):
            assert record[name] == other[name], name
    first, again = (
        read_run(path / r["run"]) for path, r in ((root, theirs[0]), (tmp_path, mine[0]))
    )
    for step in range(3):
        for a, b in zip(first.images(step), again.images(step), strict=True):
            np.testing.assert_array_equal(a, b)
    for a, b in zip(first.rows, again.rows, strict=True):
        assert (a.coverage, a.radians, a.seconds, a.sha256) == (
            b.coverage,
            b.radians,
            b.seconds,
            b.sha256,
        )
    # The run that was taken again gives the same submission, but for its policy's name.
    assert submission_of_run(again).frames[2].seconds == submission.frames[2].seconds


def test_a_submission_that_was_killed_is_judged_again_from_its_first_frame(
    finished, submission, tmp_path, monkeypatch
):
    root, cells = finished
    shutil.copytree(root / "test_views", tmp_path / "test_views")
    cell = submitted_cell(cells[0], submission, tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(module, "retake", lambda *a, **k: pytest.fail("killed"))
        with pytest.raises(BaseException, match="killed"):
            run_cell(cell, tmp_path)
    stored_submission(tmp_path, cell.submission).write_text("{}")
    with pytest.raises(ValueError, match="not a submission"):
        run_cell(cell, tmp_path)
    shorter = dataclasses.replace(submission, frames=submission.frames[:2])
    write_submission(stored_submission(tmp_path, cell.submission), shorter)
    with pytest.raises(ValueError, match="planned"):
        run_cell(cell, tmp_path)
    write_submission(stored_submission(tmp_path, cell.submission), submission)
    run_cell(cell, tmp_path)
    assert len(read_records(tmp_path)) == 2
    other = dataclasses.replace(cell, scene_hash="0" * 64, seed=5)
    with pytest.raises(CellError, match="hash"):
        run_cell(other, tmp_path)


def explored(room, out, motion="free", policy="random", **loop):
    """A recorded run, and what it was asked for."""
    config = ExplorationConfig(clock="model", voxel_size=0.1, capacity=1 << 14, **loop)
    policy = make_policy(policy, num_candidates=20, num_frontier=6, motion=make_motion(motion))
    settings = RunSettings(parse_budget("views:4"), config, policy)
    scene = SceneSettings(room, Camera.from_fov(48, 48, 90.0), seed=1)
    expedition = begin_run(settings, scene, out)
    with expedition.recorder as recorder:
        explore(
            expedition.simulator,
            policy,
            budget=settings.budget,
            seed=1,
            config=config,
            recorder=recorder,
        )
    return read_run(out)


@pytest.mark.parametrize(
    ("motion", "policy", "loop"),
    [
        ("free", "random", {"capture_every": 0.3}),
        ("free", "frontier", {"capture_every": 0.2, "gaze": "ahead", "plan_while_moving": True}),
        ("ground", "random", {}),
        ("gimbal", "random", {"capture_rate": 4.0}),
        ("handheld", "random", {}),
        ("handheld", "random", {"capture_every": 0.2}),
        ("ground", "random", {"capture_every": 0.3, "exposure": 0.02}),
    ],
)
def test_what_the_loop_does_keeps_the_rules_and_is_seen_again(room, tmp_path, motion, policy, loop):
    run = explored(room, tmp_path / "run", motion, policy, **loop)
    submission = submission_of_run(run)
    write_submission(tmp_path / "it.jsonl", submission)
    again = read_submission(tmp_path / "it.jsonl")
    assert content_hash(again) == content_hash(submission)
    assert again.config == dataclasses.replace(
        ExplorationConfig(**run.header.config), checkpoint_every=1
    )
    assert again.robot == make_motion(motion)
    simulator = again.opened.open()
    assert check_submission(again, simulator) == []
    assert len(again.frames) == len(run.rows)
    assert sum(not frame.captured for frame in again.frames) == 4
    for frame, row in zip(again.frames, run.rows, strict=True):
        seen = stored_form(simulator.render(frame.pose.astype(np.float64)))
        assert frame_hash(seen) == row.sha256


def with_frame(submission, number, **changes):
    frames = list(submission.frames)
    frames[number] = dataclasses.replace(frames[number], **changes)
    return dataclasses.replace(submission, frames=tuple(frames))


def moved(submission, number, offset, **changes):
    pose = submission.frames[number].pose.copy()
    pose[:3, 3] += np.asarray(offset, np.float32)
    return with_frame(submission, number, pose=pose, **changes)


def looking(submission, number, direction, **changes):
    position = submission.frames[number].pose[:3, 3]
    pose = np.asarray(pose_along(position, np.asarray(direction, np.float32)))
    return with_frame(submission, number, pose=pose, **changes)


def on_a_line(submission, *metres, **loop):
    """The first frame, and further ones so far along x from it; all but the last are captured."""
    first, frames = submission.frames[0], submission.frames[:1]
    for number, x in enumerate(metres, start=1):
        pose = first.pose.copy()
        pose[0, 3] += x
        captured = number < len(metres)
        frames += (SubmittedFrame(number, pose, first.seconds + number, 0.02, captured=captured),)
    exploration = submission.exploration | loop
    return dataclasses.replace(submission, frames=frames, exploration=exploration)


def with_motion(submission, **settings):
    return dataclasses.replace(submission, motion=settings)


BROKEN = {
    "another scene": (
        None,
        lambda s: dataclasses.replace(s, scene=s.scene | {"hash": "f" * 64}),
        "f" * 12,
    ),
    "captures that are not allowed": (1, lambda s: with_frame(s, 1, captured=True), "capture_rate"),
    "more captures than there are pieces": (
        4, lambda s: on_a_line(s, 0.5, 0.8, 1.2, 1.4, capture_every=0.5), "1.400 m",
    ),
    "more captures on a path that does not end": (
        3,
        lambda s: with_frame(on_a_line(s, 0.5, 0.8, 0.9, capture_rate=2.0), 3, captured=True),
        "0.900 m",
    ),
    "another start": (0, lambda s: moved(s, 0, (0.05, 0.0, 0.0)), "0.050 m"),
    "a start that looks elsewhere": (0, lambda s: looking(s, 0, (0.0, 1.0, 0.2)), "0.000 m"),
    "a start while moving": (0, lambda s: with_frame(s, 0, captured=True), "0.000 m"),
    "meters before the start": (0, lambda s: with_frame(s, 0, metres=-0.5), "`metres`"),
    "a clock that begins before 0": (0, lambda s: with_frame(s, 0, seconds=-9.0), "`seconds`"),
    "mapping before arrival": (0, lambda s: with_frame(s, 0, mapping=-5.0), "0.02 s"),
    "mapping in less than no time": (
        0,
        lambda s: with_frame(
            dataclasses.replace(s, exploration=s.exploration | {"clock": "wall"}), 0, mapping=-5.0
        ),
        "`mapping`",
    ),
    "mapping for nothing": (1, lambda s: with_frame(s, 1, mapping=0.0), "0.02 s"),
    "through the wall": (
        2, lambda s: moved(s, 2, (9.0, 0.0, 0.0), seconds=1e3, metres=1e3), " 0.000 m from",
    ),
    "too near to the wall": (
        2,
        lambda s: moved(s, 2, (1.9 - s.frames[2].pose[0, 3], 0.0, 0.0), seconds=1e3, metres=1e3),
        "keep 0.15 m",
    ),
    "a path that begins elsewhere": (
        2,
        lambda s: with_frame(
            s, 2, path=np.stack([s.frames[0].position, s.frames[2].position]), seconds=1e3
        ),
        "from a view",
    ),
    "a path that is longer than it says": (
        2,
        lambda s: with_frame(
            s,
            2,
            path=np.stack([s.frames[1].position, s.frames[1].position + 0.1, s.frames[2].position]),
            seconds=1e3,
        ),
        "`metres`",
    ),
    "faster than it can fly": (
        1, lambda s: with_frame(s, 1, seconds=s.frames[1].seconds - 0.01), "1 m/s",
    ),
    "back in time": (2, lambda s: with_frame(s, 2, seconds=0.0), "leaves -"),
    "a slower robot": (1, lambda s: with_motion(s, speed=0.2), "0.2 m/s"),
    "beyond the views": (2, lambda s: dataclasses.replace(s, budget="views:2"), "3 views"),
    "beyond the seconds": (1, lambda s: dataclasses.replace(s, budget="seconds:0.5"), "seconds:"),
    "beyond the meters": (1, lambda s: dataclasses.replace(s, budget="meters:0.01"), "meters:"),
    "beyond the frames": (2, lambda s: dataclasses.replace(s, budget="frames:2"), "3 frames"),
    "farther than can be checked": (
        None, lambda s: moved(s, 2, (1e6, 0.0, 0.0), metres=None), "20000 m",
    ),
}  # fmt: skip
"""By what is wrong: the frame, the change that makes it wrong, and the fact that is named."""


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_rule_is_named_with_its_frame(submission, scene, name):
    frame, change, fact = BROKEN[name]
    problems = check_submission(change(submission), scene)
    assert any(p.frame == frame and fact in str(p) for p in problems), list(map(str, problems))
    lines = [problem.frame or 0 for problem in problems]
    assert lines == sorted(lines)


def test_rounding_and_measured_clocks_break_no_rule(submission, scene):
    assert check_submission(submission, scene) == []
    wall = dataclasses.replace(submission, exploration=submission.exploration | {"clock": "wall"})
    assert check_submission(with_frame(wall, 1, mapping=0.0), scene) == []
    assert check_submission(moved(submission, 0, (1e-3, 0.0, 0.0)), scene) == []


@given(st.floats(0.01, 5.0), st.floats(LEAST_PIECE, 2.0), st.integers(1, 3))
def test_a_path_has_the_pieces_that_the_loop_makes_of_it_and_no_more(length, every, more):
    num = max(1, math.ceil(length / every - 1e-6))

    def problems(pieces, taken):
        metres = length * np.arange(1, pieces + 1) / pieces
        loop = {"capture_every": every, "clock": "wall", "speed": 100.0}
        made = on_a_line(make_submission(1), *metres[:taken], **loop)
        last = dataclasses.replace(made.frames[-1], captured=taken < pieces)
        made = dataclasses.replace(made, frames=(*made.frames[:-1], last))
        return list(_check_frames(made, made.frames[0].pose))

    for taken in {1, (num + 1) // 2, num}:
        assert problems(num, taken) == []
    # What rounding may take from each piece may make room for one more.
    assume(length < num * every * (1.0 - 1e-4) - 1e-3)
    assert problems(num + more, num + more) != []


def test_what_cannot_be_opened_is_a_problem_too(submission):
    gone = dataclasses.replace(submission, scene=submission.scene | {"name": "mesh:gone.ply"})
    (problem,) = problems_of(gone)
    assert "gone.ply" in str(problem)
    wide = dataclasses.replace(submission, camera=submission.camera | {"height": 30})
    (problem,) = problems_of(wide)
    assert "`camera`" in str(problem)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda s: {"frames": s.frames[:1]}, "two frames"),
        (lambda s: {"seed": 1 << 31}, "seed"),
        (lambda s: {"scene": s.scene | {"max_range": 1e9}}, "max_range"),
        (lambda s: {"exploration": s.exploration | {"voxel_size": 3.0}}, "voxel_size"),
        (lambda s: {"exploration": s.exploration | {"cell_size": 1e-3}}, "exploration.cell_size"),
    ],
)
def test_terms_that_no_training_could_keep_are_a_problem(submission, change, told):
    (problem,) = problems_of(dataclasses.replace(submission, **change(submission)))
    assert problem.frame is None
    assert told in str(problem)


def test_the_terms_are_those_of_the_exploration(submission):
    base = Conditions(resolution=512, iterations=30, gaussians=200, capacity=400, lpips="none")
    base = dataclasses.replace(base, train_resolution=48)
    assert conditions_of(submission, base, CONDITIONS.snapshots) == CONDITIONS


def test_a_run_of_a_policy_that_is_not_installed_is_exported(finished):
    root, cells = finished
    run = read_run(paths_of(root, cells[0]).run)
    motion = {"heights": [0.0, 0.0], "speed": 0.5}
    policy = {
        "name": "theirs",
        "class": "their.package:Theirs",
        "settings": {"motion": motion, "x": 1},
    }
    submission = submission_of_run(
        dataclasses.replace(run, header=dataclasses.replace(run.header, policy=policy))
    )
    assert submission.policy["version"] == ""
    assert submission.robot == make_motion("free", heights=(0.0, 0.0), speed=0.5)


@pytest.mark.parametrize("how", ["cut off", "interrupted", "forked", "merged"])
def test_a_run_that_is_no_exploration_is_not_exported(finished, how):
    root, cells = finished
    run = read_run(paths_of(root, cells[0]).run)
    header = run.header
    if how == "cut off":
        run = dataclasses.replace(run, end=None)
    elif how == "interrupted":
        run = dataclasses.replace(run, end=dataclasses.replace(run.end, outcome="interrupted"))
    else:
        header = dataclasses.replace(header, parent={how: ["x"]})
    says = {
        "cut off": "it is incomplete",
        "interrupted": "it is incomplete",
        "forked": "it is a fork",
        "merged": "merged from runs",
    }
    with pytest.raises(RunError, match=says[how]):
        submission_of_run(dataclasses.replace(run, header=header))


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
