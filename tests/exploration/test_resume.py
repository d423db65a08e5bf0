"""A run that goes on is the run that was never cut off: trace, images and maps, bit for bit."""

import random
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import jax
import numpy as np
import pytest

from r3jax.exploration import explore
from r3jax.exploration.state import StopReason
from r3jax.files import MARKER
from r3jax.runs.header import RunError, camera_fields
from r3jax.runs.reader import read_run
from r3jax.runs.stored_states import CheckpointWriter, load_checkpoint, state_of, state_tables
from r3jax.runs.writer import RunWriter
from tests.exploration.killed_run import CONFIG, small_policy
from tests.exploration.toys import BoxRoom, Wander
from tests.runs.runs import make_header
from tests.tiers import quick_and_full

VIEWS, CUT = 6, 3


def policy_of(name):
    return Wander() if name == "wander" else small_policy(name)


def run_in(path, name, views, resume=False, config=CONFIG, simulator=None):
    simulator = simulator or BoxRoom()
    if resume:
        recorder, run = RunWriter.resume(path)
    else:
        recorder, run = RunWriter(path, make_header(camera=camera_fields(simulator.camera))), None
    with recorder:
        return explore(
            simulator,
            policy_of(name),
            budget=f"views:{views}",
            config=config,
            recorder=recorder,
            resume=run,
        )


def recorded_bytes(path):
    """All that must be the same, by name."""
    names = ["trace.jsonl", *sorted(f"frames/{p.name}" for p in (path / "frames").iterdir())]
    return {name: (path / name).read_bytes() for name in names}


def assert_same_run(path, other):
    a, b = recorded_bytes(path), recorded_bytes(other)
    assert a.keys() == b.keys()
    for name in a:
        assert a[name] == b[name], name
    run, again = read_run(path), read_run(other)
    step = len(run.rows) - 1
    tables, others = run.load_checkpoint(step), again.load_checkpoint(step)
    assert tables.keys() == others.keys()
    for table in tables:
        assert tables[table].keys() == others[table].keys()
        for name, array in tables[table].items():
            np.testing.assert_array_equal(array, others[table][name], err_msg=f"{table} {name}")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Runs that were never cut off, by policy."""
    folder, done = tmp_path_factory.mktemp("whole"), {}

    def path_of(name):
        if name not in done:
            run_in(folder / name, name, VIEWS)
            done[name] = folder / name
        return done[name]

    return path_of


@pytest.mark.parametrize(
    "name",
    quick_and_full(
        [
            "wander", "r3-pano", "active-gs", "gavis", "frontier",
            "active-gs-online", "fisherrf", "gauss-mi",
        ],
        ["wander"],
        slow=["frontier", "fisherrf", "gauss-mi"],
    ),
)  # fmt: skip
def test_a_run_in_two_parts_is_the_run_in_one(tmp_path, whole, name):
    run_in(tmp_path / "run", name, CUT)
    simulator = BoxRoom()
    result = run_in(tmp_path / "run", name, VIEWS, resume=True, simulator=simulator)
    assert result.reason is StopReason.BUDGET
    assert len(simulator.rendered) == VIEWS - CUT  # what is recorded is not rendered again
    assert [row.step for row in result.rows] == list(range(VIEWS))
    assert_same_run(tmp_path / "run", whole(name))


@pytest.mark.full
def test_who_takes_over_knows_the_way_that_another_policy_came(tmp_path, whole):
    shutil.copytree(whole("r3-pano"), tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "checkpoints")
    run = read_run(tmp_path / "run")
    result = explore(
        BoxRoom(),
        policy_of("frontier"),
        budget=f"views:{VIEWS}",
        config=CONFIG,
        resume=run,
        decided_from=VIEWS,
    )
    taken_over = result.state.policy_state
    own = read_run(whole("r3-pano")).load_checkpoint(VIEWS - 1)["policy"]
    assert own["trail"].any()
    assert own["looks"].any()
    np.testing.assert_array_equal(np.asarray(taken_over.trail), own["trail"])
    np.testing.assert_array_equal(np.asarray(taken_over.looks), own["looks"])


def damage(path, how):
    checkpoints = path / "checkpoints"
    newest = sorted(checkpoints.iterdir())[-1]
    if how == "no checkpoint":
        shutil.rmtree(checkpoints)
    elif how == "an older version's checkpoint":
        tables = load_checkpoint(checkpoints, CUT - 1)
        writer = CheckpointWriter(checkpoints)
        writer.save(CUT - 1, {name: tables[name] for name in ("map", "grid")}, wait=True)
        writer.close()
    elif how == "an empty file":
        for file in (f for f in newest.rglob("*") if f.is_file()):
            file.write_bytes(b"")
    elif how == "another view's checkpoint":
        run_in(path.with_name("earlier"), "wander", CUT - 1)
        shutil.rmtree(newest)
        shutil.copytree(path.with_name("earlier") / "checkpoints" / f"{CUT - 2:06d}", newest)
    elif how == "a checkpoint after the trace":
        lines = (path / "trace.jsonl").read_text().splitlines(keepends=True)
        (path / "trace.jsonl").write_text("".join(lines[: CUT - 1]))
    elif how == "a torn row":
        with open(path / "trace.jsonl", "a") as file:
            file.write('{"kind":"step","step":3,"pose":[[0.1')
    elif how == "a half-written checkpoint":
        shutil.copytree(newest, path / MARKER / f".{CUT:06d}.ab12cd34.partial")
    elif how == "a half-written image":
        (path / MARKER / ".000003.png.ab12cd34.partial").write_bytes(b"\x89PNG")


@pytest.mark.parametrize(
    "how",
    quick_and_full(
        [
            "no checkpoint",
            "an older version's checkpoint",
            "an empty file",
            "another view's checkpoint",
            "a checkpoint after the trace",
            "a torn row",
            "a half-written checkpoint",
            "a half-written image",
        ],
        ["no checkpoint", "a torn row"],
    ),
)
def test_damage_costs_time_and_nothing_else(tmp_path, whole, how):
    run_in(tmp_path / "run", "wander", CUT)
    damage(tmp_path / "run", how)
    run_in(tmp_path / "run", "wander", VIEWS, resume=True)
    assert_same_run(tmp_path / "run", whole("wander"))
    names = sorted(p.name for p in (tmp_path / "run" / "checkpoints").iterdir())
    assert names[-1] == f"{VIEWS - 1:06d}"
    assert len(names) <= 3
    assert all(name.isdigit() for name in names)


@pytest.mark.full
def test_a_state_comes_back_from_its_tables(whole):
    """What is not an array comes from the first state, arrays keep shape and type."""
    for name in ("r3-pano", "active-gs", "active-gamer", "frontier", "wander"):
        simulator, policy = BoxRoom(), policy_of(name)
        state = explore(simulator, policy, budget="views:2", config=CONFIG).state
        first = explore(simulator, policy, budget="views:1", config=CONFIG).state
        back = state_of(state_tables(state), first)
        a, b = vars(state), vars(back)
        for field in a:
            assert jax.tree.structure(a[field]) == jax.tree.structure(b[field]), field
            for x, y in zip(*map(jax.tree.leaves, (a[field], b[field])), strict=True):
                assert type(x) is type(y), field
                np.testing.assert_array_equal(x, y, err_msg=f"{name} {field}")


def test_tables_that_do_not_fit_are_refused():
    simulator = BoxRoom()
    state = explore(simulator, Wander(), budget="views:1", config=CONFIG).state
    tables = state_tables(state)
    with pytest.raises(ValueError, match="loop"):
        state_of({name: tables[name] for name in ("map", "grid", "policy")}, state)
    with pytest.raises(ValueError, match="memory"):
        state_of(tables | {"policy": tables["policy"] | {"memory": np.zeros(3)}}, state)
    with pytest.raises(ValueError, match="frames"):
        state_of(tables | {"policy": tables["policy"] | {"frames": np.asarray(1.5)}}, state)
    with pytest.raises(ValueError, match="bins"):
        state_of(tables | {"map": tables["map"] | {"num_bins": np.asarray(128)}}, state)


def test_how_a_run_ended_before_is_kept(tmp_path):
    run_in(tmp_path / "run", "wander", CUT)
    run_in(tmp_path / "run", "wander", VIEWS, resume=True)
    run = read_run(tmp_path / "run")
    assert run.end is not None
    assert (run.end.outcome, run.end.views) == ("budget", VIEWS)
    history = (tmp_path / "run" / "history.jsonl").read_text()
    assert history.count('"kind": "begin"') == 2
    assert history.count('"kind":"end"') == 1
    assert f'"views":{CUT}' in history
    assert len(run.timings) == VIEWS


def test_a_finished_run_goes_on_to_the_same_end(tmp_path, whole):
    path = tmp_path / "run"
    shutil.copytree(whole("wander"), path)
    result = run_in(path, "wander", VIEWS, resume=True)
    assert result.reason is StopReason.BUDGET
    assert_same_run(path, whole("wander"))


def test_a_broken_frame_that_is_needed_is_named(tmp_path):
    path = tmp_path / "run"
    run_in(path, "wander", CUT)
    shutil.rmtree(path / "checkpoints")
    (path / "frames" / "000001.depth.png").write_bytes(b"not a picture")
    with pytest.raises(RunError, match=r"000001\.depth\.png"):
        run_in(path, "wander", VIEWS, resume=True)
    with pytest.raises(RunError, match=r"000001\.depth\.png"):  # and the lock is free again
        run_in(path, "wander", VIEWS, resume=True)


def test_two_processes_cannot_write_one_run(tmp_path):
    path = tmp_path / "run"
    run_in(path, "wander", CUT)
    before = recorded_bytes(path)
    writer, _ = RunWriter.resume(path)
    with writer, pytest.raises(RunError):
        RunWriter.resume(path)
    after = recorded_bytes(path)
    assert before["trace.jsonl"].startswith(after["trace.jsonl"])  # the end row moved, no more


def test_a_folder_that_is_no_run_is_left_alone(tmp_path):
    with pytest.raises(RunError):
        RunWriter.resume(tmp_path)
    assert not list(tmp_path.iterdir())


def test_the_wall_clock_goes_on_too(tmp_path):
    config = replace(CONFIG, clock="wall")
    run_in(tmp_path / "run", "wander", CUT, config=config)
    before = read_run(tmp_path / "run").rows
    result = run_in(tmp_path / "run", "wander", VIEWS, resume=True, config=config)
    assert [row.seconds for row in result.rows[:CUT]] == [row.seconds for row in before]
    assert np.all(np.diff([row.seconds for row in result.rows]) > 0.0)


def _start(path, views, name):
    command = [sys.executable, "-m", "tests.exploration.killed_run", str(path), str(views), name]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def _finish(path, views, name):
    process = _start(path, views, name)
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors.decode()


def _size(path):
    return path.stat().st_size if path.exists() else 0


def _kill_at_random_moments(path, views, name, kills, span, rng):
    """Kills process after process while it writes the run; how many views each one left."""
    left = []
    for _ in range(kills):
        process = _start(path, views, name)
        begun = _size(path / "history.jsonl")
        while process.poll() is None and _size(path / "history.jsonl") == begun:
            time.sleep(0.002)
        time.sleep(rng.uniform(0.0, span))
        process.send_signal(signal.SIGKILL)
        process.communicate(timeout=60)
        trace = path / "trace.jsonl"
        left.append(trace.read_bytes().count(b"\n") if trace.exists() else 0)
    return left


@pytest.mark.parametrize(
    ("views", "name", "kills", "span"),
    [
        (6, "frontier", 1, 1.5),
        pytest.param(8, "r3-pano", 3, 1.5, marks=pytest.mark.slow),
        pytest.param(40, "r3-pano", 30, 2.5, marks=pytest.mark.slow),
    ],
)
def test_a_run_survives_kills_at_random_moments(tmp_path, views, name, kills, span):
    _finish(tmp_path / "whole", views, name)
    left = _kill_at_random_moments(tmp_path / "run", views, name, kills, span, random.Random(views))
    assert left == sorted(left)  # nothing that was recorded is ever lost
    _finish(tmp_path / "run", views, name)
    assert_same_run(tmp_path / "run", tmp_path / "whole")
