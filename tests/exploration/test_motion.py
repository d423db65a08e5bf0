"""The mission of a carrier: its clock by hand, its first view, a ground robot in a real flat."""

import json
from dataclasses import replace
from itertools import pairwise

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from r3jax.cli.main import main
from r3jax.exploration.config import ExplorationConfig
from r3jax.exploration.loop import explore
from r3jax.exploration.state import StopReason
from r3jax.geometry.cameras import pose_along
from r3jax.planning.registry import make_policy
from r3jax.planning.robot.motion import MOTIONS, Motion, motion_of_record
from r3jax.runs.reader import read_run
from r3jax.runs.replay import explain_run
from tests.cli.small_runs import main_without_report
from tests.exploration.toys import BoxRoom

CONFIG = ExplorationConfig(voxel_size=0.1, capacity=1 << 14, clock="model", num_probes=4)


def mission(motion: Motion, budget: str, simulator: BoxRoom | None = None):
    policy = make_policy("random", num_candidates=8, num_frontier=0, motion=motion)
    return explore(simulator or BoxRoom(), policy, budget=budget, config=CONFIG)


def turned(before: np.ndarray, after: np.ndarray) -> float:
    """Angle of the rotation between two poses [deg]."""
    first, second = (Rotation.from_matrix(pose[:3, :3].astype(float)) for pose in (before, after))
    return np.degrees((first.inv() * second).magnitude())


def test_the_clock_charges_the_way_and_the_turn():
    motion = Motion(speed=0.25, turn_rate=30.0)
    rows = mission(motion, "views:5").rows
    for before, row in pairwise(rows):
        seconds = row.choice.length / 0.25 + turned(before.pose, row.pose) / 30.0
        assert row.charged["flight"] == pytest.approx(seconds, abs=0.01)
    fast = mission(Motion(), "views:5").rows
    assert [row.charged["flight"] for row in fast[1:]] == [row.choice.length for row in fast[1:]]


def test_a_slow_carrier_takes_fewer_views_in_the_same_time():
    fast, slow = (
        mission(Motion(speed=speed, turn_rate=60.0), "seconds:12") for speed in (1.0, 0.1)
    )
    assert fast.reason is slow.reason is StopReason.BUDGET
    assert len(slow.rows) < len(fast.rows)
    assert slow.state.seconds <= 12.02


def test_the_first_view_is_one_that_the_carrier_can_take():
    simulator = BoxRoom()
    simulator.start_pose = np.asarray(
        pose_along(jnp.array([1.2, 1.1, 1.3]), jnp.array([1.0, 0.3, 0.8])), np.float64
    )
    tilted = replace(MOTIONS["ground"], elevations=(-15.0, -15.0), body=0.5)
    rows = mission(tilted, "views:4", simulator).rows
    assert len(rows) == 4
    for row in rows:
        assert np.degrees(np.arcsin(row.pose[2, 2])) == pytest.approx(-15.0, abs=1e-3)
        assert row.pose[2, 3] == rows[0].pose[2, 3]
    low = Motion(heights=(0.2, 0.5), heights_above="world")
    with pytest.raises(ValueError, match=r"1\.300 m.*0\.200"):
        mission(low, "views:2")


@pytest.fixture(scope="module")
def ground_run(tmp_path_factory):
    """Eight views of the embedded flat by a robot on wheels."""
    out = tmp_path_factory.mktemp("runs")
    words = "--scene flat --motion ground --speed 0.4 --resolution 96 --clock model --candidates 30"
    assert (
        main_without_report(["explore", *words.split(), "--budget", "views:8", "--out", str(out)])
        == 0
    )
    return out / "flat-r3-pano-ground-seed0"


@pytest.mark.full
def test_a_ground_robot_stays_level_at_its_height(ground_run):
    rows = read_run(ground_run).rows
    assert len(rows) == 8
    assert {float(row.pose[2, 3]) for row in rows} == {float(np.float32(1.3))}
    assert np.abs([row.pose[2, 2] for row in rows]).max() < 1e-7
    assert np.abs([row.pose[2, 0] for row in rows]).max() < 1e-7
    for before, row in pairwise(rows):
        assert np.all(row.choice.waypoints[:, 2] == np.float32(1.3))
        seconds = row.choice.length / 0.4 + turned(before.pose, row.pose) / 60.0
        assert row.charged["flight"] == pytest.approx(seconds, abs=0.01)
    assert rows[-1].metres > 0.5
    assert rows[-1].radians > 1.0


@pytest.mark.full
def test_its_views_can_be_explained_in_hindsight(ground_run):
    reasons = list(explain_run(read_run(ground_run)))
    assert reasons[0] is None
    assert all(reason.totals.sum() > 0.0 for reason in reasons[1:])


@pytest.mark.full
def test_resume_and_fork_keep_the_motion(ground_run):
    wanted = replace(MOTIONS["ground"], speed=0.4)
    assert motion_of_record(read_run(ground_run).header.policy["settings"]["motion"]) == wanted
    assert main_without_report(["explore", "--resume", str(ground_run), "--budget", "views:9"]) == 0
    out = ground_run.parent
    words = ["--fork", str(ground_run), "--at", "3", "--policy", "frontier", "--budget", "views:5"]
    assert main_without_report(["explore", *words, "--name", "forked", "--out", str(out)]) == 0
    forked = json.loads((out / "forked" / "run.json").read_text())
    assert motion_of_record(forked["policy"]["settings"]["motion"]) == wanted
    for path, views in ((ground_run, 9), (out / "forked", 5)):
        rows = read_run(path).rows
        assert len(rows) == views
        assert {float(row.pose[2, 3]) for row in rows} == {float(np.float32(1.3))}
        assert np.abs([row.pose[2, 2] for row in rows]).max() < 1e-7


@pytest.mark.full
def test_the_command_line_says_what_cannot_work(tmp_path, capsys):
    words = ["explore", "--scene", "flat", "--resolution", "32", "--out", str(tmp_path)]
    for wrong, says in (
        (["--heights", "0.2", "0.5"], "heights"),
        (["--turn-rate", "30"], "speed"),
        (["--heights", "0.2", "0.5", "--heights-above", "world"], "1.300 m"),
        (["--elevations", "-95", "0"], "elevations"),
    ):
        assert main([*words, *wrong]) == 2
        assert says in " ".join(capsys.readouterr().err.split())
    assert not list(tmp_path.iterdir())
