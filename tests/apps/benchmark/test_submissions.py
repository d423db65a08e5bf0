"""Submissions: a run, its poses, and from these alone the same images and the same scores."""

import dataclasses
import math
import re
import shutil

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from r3jax.apps.benchmark import run_cell as module
from r3jax.apps.benchmark import submission_checks
from r3jax.apps.benchmark.cells import paths_of
from r3jax.apps.benchmark.conditions import Conditions
from r3jax.apps.benchmark.record import read_records
from r3jax.apps.benchmark.run_cell import CellError, run_cell
from r3jax.apps.benchmark.submission_checks import check_submission
from r3jax.apps.benchmark.submitted import (
    conditions_of,
    open_submitted,
    problems_of,
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
from r3jax.runs.header import RunError
from r3jax.runs.reader import read_run
from r3jax.runs.settings import RunSettings, SceneSettings
from tests.apps.benchmark.tiny import CONDITIONS
from tests.formats.test_submissions import make_submission


@pytest.fixture(scope="module")
def submission(finished):
    """Of the exploration of the first finished cell."""
    root, cells = finished
    return submission_of_run(read_run(paths_of(root, cells[0]).run))


@pytest.fixture(scope="module")
def scene(submission):
    return open_submitted(submission)


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
    with pytest.raises(ValueError, match="this is no submission"):
        run_cell(cell, tmp_path)
    shorter = dataclasses.replace(submission, frames=submission.frames[:2])
    write_submission(stored_submission(tmp_path, cell.submission), shorter)
    with pytest.raises(ValueError, match="is not what was planned"):
        run_cell(cell, tmp_path)
    write_submission(stored_submission(tmp_path, cell.submission), submission)
    run_cell(cell, tmp_path)
    assert len(read_records(tmp_path)) == 2
    other = dataclasses.replace(cell, scene_hash="0" * 64, seed=5)
    with pytest.raises(CellError, match="changed meanwhile"):
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
    simulator = open_submitted(again)
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
        lambda s: dataclasses.replace(s, scene=s.scene | {"hash": "f" * 64}),
        r"line 1: the scene .* has the hash \w{12} here, f{12} in the submission",
    ),
    "captures that are not allowed": (
        lambda s: with_frame(s, 1, captured=True),
        "line 3, frame 1: it is captured on the way, but `exploration` in line 1 has neither",
    ),
    "more captures than there are pieces": (
        lambda s: on_a_line(s, 0.5, 0.8, 1.2, 1.4, capture_every=0.5),
        "line 3, frame 1: 3 frames are captured on the 1.400 m to frame 4, one each 0.5 m are",
    ),
    "captures at one place": (
        lambda s: on_a_line(s, 0.5, 0.5, 1.6, capture_every=0.5),
        "line 4, frame 2: it is captured 0.000 m after the frame before: keep 0.333 m on this leg",
    ),
    "captures at one place on a leg that does not end": (
        lambda s: with_frame(on_a_line(s, 0.5, 0.9, 1.2, capture_rate=2.0), 3, captured=True),
        "line 5, frame 3: it is captured 0.300 m after the frame before: keep 0.375 m on this leg",
    ),
    "another start": (
        lambda s: moved(s, 0, (0.05, 0.0, 0.0)),
        "line 2, frame 0: it lies 0.050 m and 0.00 degrees from the scene's start",
    ),
    "a start that looks elsewhere": (
        lambda s: looking(s, 0, (0.0, 1.0, 0.2)),
        "line 2, frame 0: it lies 0.000 m and .* degrees from the scene's start",
    ),
    "a fixed camera that looks aside": (
        lambda s: with_motion(on_a_line(s, 0.4, 0.7, capture_every=0.4), fixed_camera=True),
        r"line 3, frame 1: it looks \d+\.\d degrees off the way to the next frame, a fixed camera "
        "at most 0.0",
    ),
    "a start on the way": (
        lambda s: with_frame(s, 0, captured=True),
        "line 2, frame 0: it is captured on the way from nowhere",
    ),
    "meters before the start": (
        lambda s: with_frame(s, 0, metres=0.5),
        "line 2, frame 0: it comes after 0.5 m:",
    ),
    "a clock that begins before the start": (
        lambda s: with_frame(s, 0, seconds=-1000.0),
        "line 2, frame 0: `seconds` is -1000, less than its mapping",
    ),
    "a start that is mapped before it is seen": (
        lambda s: with_frame(s, 0, mapping=-5.0),
        "line 2, frame 0: `mapping` is -5 s, on the model clock it takes 0.02 s",
    ),
    "mapping in less than no time": (
        lambda s: with_frame(
            dataclasses.replace(s, exploration=s.exploration | {"clock": "wall"}), 0, mapping=-5.0
        ),
        "line 2, frame 0: `mapping` is -5 s, it takes no less than 0 s",
    ),
    "through the wall": (
        lambda s: moved(s, 2, (9.0, 0.0, 0.0), seconds=1e3, metres=1e3),
        "line 4, frame 2: its path runs through a surface",
    ),
    "too near to the wall": (
        lambda s: moved(s, 2, (1.9 - s.frames[2].pose[0, 3], 0.0, 0.0), seconds=1e3, metres=1e3),
        "line 4, frame 2: its path comes as near as 0.1|runs through",
    ),
    "a path that begins elsewhere": (
        lambda s: with_frame(
            s, 2, path=np.stack([s.frames[0].position, s.frames[2].position]), seconds=1e3
        ),
        "line 4, frame 2: its path ends 0.* m from a view",
    ),
    "a path that is longer than it says": (
        lambda s: with_frame(
            s,
            2,
            path=np.stack([s.frames[1].position, s.frames[1].position + 0.1, s.frames[2].position]),
            seconds=1e3,
        ),
        "line 4, frame 2: `metres` grows by .* the path has",
    ),
    "faster than it can fly": (
        lambda s: with_frame(s, 1, seconds=s.frames[1].seconds - 0.01),
        r"line 3, frame 1: it arrives .* s after the frame before, a decision on the model clock "
        r"and .* m at 1 m/s take",
    ),
    "back in time": (
        lambda s: with_frame(s, 2, seconds=0.0),
        "line 4, frame 2: it arrives -",
    ),
    "mapping for nothing": (
        lambda s: with_frame(s, 1, mapping=0.0),
        "line 3, frame 1: `mapping` is 0 s, on the model clock it takes 0.02 s",
    ),
    "beyond the budget": (
        lambda s: dataclasses.replace(s, budget="views:2"),
        "line 4, frame 2: it takes 3 views, beyond the budget views:2",
    ),
    "beyond the budget of seconds": (
        lambda s: dataclasses.replace(s, budget="seconds:0.5"),
        "line 3, frame 1: it takes .* seconds, beyond the budget seconds:0.5",
    ),
    "beyond the budget of meters": (
        lambda s: dataclasses.replace(s, budget="meters:0.01"),
        "line 3, frame 1: it takes .* meters, beyond the budget meters:0.01",
    ),
    "a slower robot": (
        lambda s: with_motion(s, speed=0.2),
        "line 3, frame 1: it arrives .* at 0.2 m/s",
    ),
    "a robot that turns": (
        lambda s: with_motion(s, speed=1.0, turn_rate=1.0),
        "line 3, frame 1: it arrives .* and a turn by .* degrees at 1 degrees/s",
    ),
    "a robot that walks": (
        lambda s: with_motion(s, turn_per_meter=1.0),
        "line 3, frame 1: it turns by .* degrees over",
    ),
    "a robot on the ground": (
        lambda s: with_motion(s, heights=[0.0, 0.0]),
        "line 3, frame 1: its path reaches from",
    ),
    "a robot that may not rise": (
        lambda s: moved(
            with_motion(s, heights=[-9.0, 0.0]),
            2,
            (0.0, 0.0, 0.3 + s.frames[0].pose[2, 3] - s.frames[2].pose[2, 3]),
            path=None,
        ),
        "line 4, frame 2: its path reaches from",
    ),
    "a robot that looks ahead": (
        lambda s: with_motion(s, elevations=[0.0, 0.0]),
        "line 3, frame 1: it looks .* degrees above the horizon",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_rule_is_named_with_its_line(submission, scene, name):
    assert_named(check_submission, submission, scene, name)


def assert_named(check, submission, scene, name):
    change, says = BROKEN[name]
    problems = [str(problem) for problem in check(change(submission), scene)]
    assert any(re.match(says, problem) for problem in problems), problems


def law_rules(submission, scene) -> None:
    """What keeps the rules has no problem; what breaks one is told which, and where."""
    check = submission_checks.check_submission
    assert check(submission, scene) == []
    # Measured clocks charge what they charge, and a place or a look may be rounded.
    wall = dataclasses.replace(submission, exploration=submission.exploration | {"clock": "wall"})
    assert check(with_frame(wall, 1, mapping=0.0), scene) == []
    assert check(moved(submission, 0, (1e-3, 0.0, 0.0)), scene) == []
    for name in BROKEN:
        assert_named(check, submission, scene, name)


def law_time(submission, scene) -> None:
    """A whole flight turns after it has flown; on the way the camera turns while it flies."""
    robot = with_motion(submission, speed=1.0, turn_rate=10.0)
    terms = submission_checks._Terms(
        parse_budget(robot.budget),
        robot.config,
        robot.robot,
        robot.robot.heights_from(1.0),
        robot.intrinsics,
    )
    first, second, third = robot.frames[:3]

    def least(before, frame, length, **changes):
        step = submission_checks._Step(frame, before, np.zeros((2, 3)), length, 0.0, 1)
        return submission_checks._least_seconds(
            step, dataclasses.replace(terms, **changes), length
        )[0]

    captured = dataclasses.replace(second, captured=True)
    turn = submission_checks._Step(second, first, np.zeros((2, 3)), 1.0, 0.0, 1).turn / 10.0
    assert turn > 1.0
    decision = terms.cost("planning")
    assert least(first, second, 2.0) == pytest.approx(2.0 + turn + decision)
    assert least(first, captured, 2.0) == pytest.approx(max(2.0, turn) + decision)
    # What follows a frame on the way was decided before it.
    after = submission_checks._Step(third, captured, np.zeros((2, 3)), 1.0, 0.0, 1).turn / 10.0
    assert least(captured, third, 2.0) == pytest.approx(max(2.0, after))
    ahead = dataclasses.replace(terms.config, plan_while_moving=True)
    shorter = terms.cost("reconsidering")
    assert 0.0 < shorter < decision
    assert least(first, second, 2.0, config=ahead) == pytest.approx(2.0 + turn + shorter)


@given(st.floats(0.01, 5.0), st.floats(LEAST_PIECE, 2.0), st.integers(1, 3))
def test_a_leg_has_the_pieces_that_the_loop_makes_of_it_and_no_more(length, every, more):
    num = max(1, math.ceil(length / every - 1e-6))

    def problems(pieces, taken):
        metres = length * np.arange(1, pieces + 1) / pieces
        made = on_a_line(make_submission(1), *metres[:taken], capture_every=every)
        last = dataclasses.replace(made.frames[-1], captured=taken < pieces)
        made = dataclasses.replace(made, frames=(*made.frames[:-1], last))
        checks, settings = submission_checks, (made.config, made.robot, (-9.0, 9.0))
        terms = checks._Terms(parse_budget(made.budget), *settings, made.intrinsics)
        return [p for leg in checks._legs(made) for p in checks._on_the_way(leg, terms)]

    for taken in {1, (num + 1) // 2, num}:
        assert problems(num, taken) == []
    # What rounding may take from each piece may make room for one more.
    assume(length < num * submission_checks._less(every) - 1e-3)
    assert problems(num + more, num + more) != []


@pytest.mark.parametrize("law", [law_rules, law_time])
def test_laws_hold_without_a_fault(law, submission, scene):
    law(submission, scene)


def test_what_cannot_be_opened_is_a_problem_too(submission):
    gone = dataclasses.replace(submission, scene=submission.scene | {"name": "mesh:gone.ply"})
    (problem,) = problems_of(gone)
    assert "gone.ply" in str(problem)
    wide = dataclasses.replace(submission, camera=submission.camera | {"height": 30})
    (problem,) = problems_of(wide)
    assert "square images" in str(problem)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda s: {"frames": s.frames[:1]}, "two frames at least"),
        (lambda s: {"seed": 1 << 31}, "`seed` must lie between 0 and 2"),
        (lambda s: {"scene": s.scene | {"max_range": 1e9}}, "max_range must be at most"),
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


@pytest.mark.parametrize(
    "how", ["cut off", "interrupted", "forked", "merged", "a start of its own"]
)
def test_a_run_that_is_no_exploration_is_not_exported(finished, how):
    root, cells = finished
    run = read_run(paths_of(root, cells[0]).run)
    header = run.header
    if how == "cut off":
        run = dataclasses.replace(run, end=None)
    elif how == "interrupted":
        run = dataclasses.replace(run, end=dataclasses.replace(run.end, outcome="interrupted"))
    elif how == "a start of its own":
        header = dataclasses.replace(header, scene=header.scene | {"start": [0.0, 0.0, 0.0]})
    else:
        header = dataclasses.replace(header, parent={how: ["x"]})
    says = {
        "cut off": "it is not over",
        "interrupted": "it is not over",
        "forked": "it is a fork",
        "merged": "merged from runs",
        "a start of its own": "--start",
    }
    with pytest.raises(RunError, match=says[how]):
        submission_of_run(dataclasses.replace(run, header=header))
