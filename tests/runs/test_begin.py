"""Forks that are taken on the way: where they go on, and what they are told of the path."""

import dataclasses
from itertools import pairwise

import numpy as np
import pytest

from r3jax.exploration.loop import explore
from r3jax.planning.registry import make_policy
from r3jax.runs.begin import fork_run, merge_runs
from r3jax.runs.header import RunError
from r3jax.runs.reader import read_run
from r3jax.runs.replay import explain_run
from r3jax.runs.settings import settings_of_run
from tests.box_room import write_room
from tests.cli import small_runs

pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two runs that end on the way, and both as one."""
    out = tmp_path_factory.mktemp("runs")
    room = write_room(tmp_path_factory.mktemp("mesh") / "room.ply")
    for seed in ("0", "1"):
        words = ["--name", seed, "--seed", seed, "--policy", "r3", "--gaze", "ahead"]
        words += ["--capture-every", "0.1", "--budget", "frames:7"]
        assert small_runs.explore(room, out, *words) == 0
    both = [read_run(out / seed) for seed in ("0", "1")]
    merge_runs(both, out / "merged")
    return out


def on_the_way(run, least):
    """The first frame from number `least` on that is on the way, as is the one before it."""
    ways = pairwise(run.rows)
    return next(b.step for a, b in ways if a.captured and b.captured and b.step >= least)


def go(expedition, num):
    """Goes on until there are `num` frames."""
    with expedition.recorder:
        explore(
            expedition.simulator,
            expedition.settings.policy,
            budget=f"frames:{num}",
            seed=expedition.seed,
            config=expedition.settings.config,
            recorder=expedition.recorder,
            resume=expedition.recorded,
            decided_from=expedition.decided_from,
        )
    return read_run(expedition.recorder.path)


def of_another_policy(run):
    """The settings of a run, for a fork by another policy than its own."""
    settings = settings_of_run(run)
    other = make_policy("random", **vars(settings.policy.config))
    return dataclasses.replace(settings, policy=other)


def test_a_fork_of_a_merged_run_goes_on_where_the_camera_is(runs, tmp_path):
    run = read_run(runs / "merged")
    at = on_the_way(run, 9)
    fork = go(fork_run(run, at, settings_of_run(run), tmp_path / "fork"), at + 2)
    assert fork.header.parent["decided_from"] == at
    for before, row in pairwise(fork.rows[at - 1 :]):
        straight = np.linalg.norm(row.pose[:3, 3] - before.pose[:3, 3])
        assert straight <= 1.001 * (row.metres - before.metres) + 1e-4
        assert straight <= 1.001 * row.charged["flight"] + 1e-4  # at 1 m/s


def test_what_a_merged_run_was_after_is_not_told_by_its_forks_either(runs, tmp_path):
    merged = read_run(runs / "merged")
    settings = settings_of_run(merged)
    with fork_run(merged, 9, settings, tmp_path / "fork").recorder:
        fork = read_run(tmp_path / "fork")
    with fork_run(fork, 8, settings, tmp_path / "again").recorder:
        again = read_run(tmp_path / "again")
    for run in (fork, again):
        with pytest.raises(RunError, match="merged"):
            list(explain_run(run))
    alone = read_run(runs / "0")
    with fork_run(alone, 5, settings, tmp_path / "own").recorder:
        assert any(explain_run(read_run(tmp_path / "own")))


def test_who_takes_over_on_the_way_is_not_told_what_lies_ahead(runs, tmp_path):
    run = read_run(runs / "0")
    at = on_the_way(run, 2)
    settings = of_another_policy(run)
    with fork_run(run, at, settings, tmp_path / "fork").recorder:
        fork = read_run(tmp_path / "fork")
    begin = max(row.step for row in run.rows[:at] if row.choice is not None)
    whole, told = run.rows[begin].choice, fork.rows[begin].choice
    flown = run.rows[at - 1].metres - run.rows[begin - 1].metres
    assert flown < whole.length - 0.05
    assert told.length == pytest.approx(flown)
    np.testing.assert_allclose(told.waypoints[0], whole.waypoints[0], atol=1e-5)
    np.testing.assert_allclose(told.waypoints[-1], run.rows[at - 1].pose[:3, 3], atol=1e-4)
    # All that was flown to its end, and what the same policy decides again, stays as it was.
    lines = [(path / "trace.jsonl").read_text().splitlines() for path in (run.path, fork.path)]
    assert [a == b for a, b in zip(*lines, strict=False)] == [n != begin for n in range(at)]
    with fork_run(run, at, settings_of_run(run), tmp_path / "same").recorder:
        same = (tmp_path / "same" / "trace.jsonl").read_bytes()
    assert (runs / "0" / "trace.jsonl").read_bytes().startswith(same)


def test_another_policy_may_take_over_from_the_start(runs, tmp_path):
    run = read_run(runs / "0")
    settings = of_another_policy(run)
    fork = go(fork_run(run, 1, settings, tmp_path / "fork"), 3)
    np.testing.assert_array_equal(fork.rows[0].pose, run.rows[0].pose)
    assert len(fork.rows) == 3


def test_a_fork_of_a_fork_decides_from_where_it_leaves_it(runs, tmp_path):
    run = read_run(runs / "0")
    settings = of_another_policy(run)
    with fork_run(run, 5, settings, tmp_path / "late").recorder:
        late = read_run(tmp_path / "late")
    with fork_run(late, 3, settings, tmp_path / "early").recorder:
        assert read_run(tmp_path / "early").header.parent["decided_from"] == 3
