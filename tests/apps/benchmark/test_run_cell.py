"""One cell: done once, recorded whole, and the same record however often it was killed."""

import dataclasses
import json
import shutil
import signal
import subprocess
import sys

import pytest

from r3jax.apps.benchmark import run_cell as module
from r3jax.apps.benchmark.cells import paths_of, snapshots_left
from r3jax.apps.benchmark.record import collect, read_records
from r3jax.apps.benchmark.run_cell import CellError, run_cell, steps_within
from r3jax.files import own_folder
from r3jax.runs.header import RunError
from r3jax.runs.reader import read_run
from r3jax.validation.json_text import unsealed
from tests.apps.benchmark.tiny import SETTINGS, make_cells

SCHEMA = {
    "format": int,
    "scene": str,
    "scene_hash": str,
    "policy": str,
    "settings": dict,
    "seed": int,
    "budget": str,
    "snapshot": str,
    "clock": str,
    "resolution": int,
    "sensing": dict.fromkeys(("fov", "noise", "max_range", "voxel_size", "cell_size"), float),
    "lpips_network": str,
    "training": dict.fromkeys(("iterations", "resolution", "gaussians", "capacity", "seed"), int)
    | {"strategy": str},
    "test_views": {"hash": str, "count": int, "resolution": int},
    "exploration": dict.fromkeys(
        ("seconds", "metres", "radians", "known_share", "mean_renderability"), float
    )
    | {"views": int, "map_bytes": int, "outcome": str},
    "measured": {"decision_ms": float},
    "metrics": dict.fromkeys(("psnr", "psnr_measured", "ssim"), dict) | {"lpips": None},
    "views": dict.fromkeys(
        ("view", "psnr", "psnr_measured", "ssim", "coverage", "measured", "renderability"), list
    )
    | {"lpips": None},
    "run": str,
    "machine": str,
    "commit": str,
    "packages": dict,
}
SUMMARY = {"mean", "interval", "median", "percentile_5", "worst", "worst_view", "poor_share"}


def assert_follows(value, schema):
    if isinstance(schema, dict):
        assert value.keys() == schema.keys()
        for name, part in schema.items():
            assert_follows(value[name], part)
    else:
        assert value is None if schema is None else type(value) is schema


@pytest.mark.full
def test_each_snapshot_leaves_a_record_of_the_schema(finished):
    root, cells = finished
    records = read_records(root)
    assert [(r["seed"], r["snapshot"]) for r in records] == [
        (seed, snapshot) for seed in (0, 1) for snapshot in ("views:2", "views:3")
    ]
    for record in records:
        assert_follows(record, SCHEMA | ({} if record["commit"] else {"commit": None}))
        assert record["exploration"]["views"] == int(record["snapshot"][-1])
        assert record["exploration"]["outcome"] == "budget"
        assert record["settings"] == SETTINGS
        for metric in ("psnr", "psnr_measured", "ssim"):
            assert record["metrics"][metric].keys() == SUMMARY
        for column in record["views"].values():
            assert column is None or len(column) == record["test_views"]["count"] == 4
        assert len(read_run(root / record["run"]).rows) == 3
    lines = collect(root).read_text().splitlines()
    assert [unsealed(json.loads(line)) for line in lines] == records
    assert all(not snapshots_left(root, cell) for cell in cells)


@pytest.mark.full
def test_what_is_done_is_not_done_again(finished, monkeypatch):
    root, cells = finished

    def again(*args, **kwargs):
        pytest.fail("done a second time")

    for name in ("explore", "evaluate", "map_of", "make_record"):
        monkeypatch.setattr(module, name, again)
    monkeypatch.setattr(module.train, "fit", again)
    run_cell(cells[0], root)


@pytest.mark.full
def test_a_snapshot_that_is_asked_for_later_takes_the_exploration_that_is_there(
    finished, room, tmp_path, monkeypatch
):
    root, cells = finished
    copy = shutil.copytree(root, tmp_path / "copy")
    conditions = dataclasses.replace(cells[0].conditions, snapshots=("views:3", "metres:100"))
    more = dataclasses.replace(cells[0], conditions=conditions)
    assert snapshots_left(copy, more) == ("metres:100",)
    monkeypatch.setattr(module, "explore", lambda *a, **k: pytest.fail("explored again"))
    run_cell(more, copy)
    records = {r["snapshot"]: r for r in read_records(copy, [more])}
    assert records["metres:100"]["metrics"] == records["views:3"]["metrics"]


@pytest.mark.full
def test_a_snapshot_sees_the_views_up_to_it_and_no_others(finished, room, tmp_path):
    """What a cell says of its second view is what a cell ends with that has no third."""
    root, cells = finished
    (short,) = make_cells(room, tmp_path, budget="views:2", snapshots=("views:2",))
    run_cell(short, tmp_path)
    (record,) = read_records(tmp_path)
    long = read_records(root, cells[:1])[0]
    for name in ("metrics", "views", "exploration", "snapshot"):
        assert record[name] == long[name]


@pytest.mark.full
def test_steps_within_a_snapshot_arrived_in_time(finished):
    root, cells = finished
    run = read_run(paths_of(root, cells[0]).run)
    assert len(run.rows) == 3
    for number, row in enumerate(run.rows[1:], start=1):
        arrival = row.seconds - row.charged["mapping"]
        for unit, amount in (("seconds", arrival), ("metres", row.metres)):
            assert len(steps_within(run, f"{unit}:{amount + 1e-6:.9f}")) == number + 1
            assert len(steps_within(run, f"{unit}:{amount - 1e-6:.9f}")) == number
        assert len(steps_within(run, f"views:{number}")) == number


def run_until(stage, room, root):
    """Starts the cell in a process of its own, kills it when a stage begins; the stages before."""
    command = [sys.executable, "-m", "tests.apps.benchmark.tiny", room, str(root), stage]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        seen = []
        for line in process.stdout:
            seen.append(line.strip())
            if seen[-1].startswith(stage):
                process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
    return seen


def without_clock(record):
    """What does not depend on when and where it was made."""
    return {
        name: value
        for name, value in record.items()
        if name not in ("commit", "machine", "measured")
    }


@pytest.mark.slow
def test_a_cell_that_is_killed_again_and_again_ends_in_the_same_record(finished, room, tmp_path):
    (cell,) = make_cells(room, tmp_path)
    paths = paths_of(tmp_path, cell)
    run_until("exploring, 2 views", room, tmp_path)
    assert read_run(paths.run).end is None
    stages = run_until("views:2: training, step 20", room, tmp_path)
    assert "exploring, 3 views" in stages  # cut off in the middle: from the start again
    stages = run_until("views:3: evaluating", room, tmp_path)
    assert not any(stage.startswith("exploring") for stage in stages)
    steps = [int(s.split()[-1].split("/")[0]) for s in stages if "views:2: training" in s]
    assert steps[0] > 18  # behind the checkpoint, not at the start
    assert paths.record("views:2").exists()
    assert not paths.record("views:3").exists()
    stages = []
    run_cell(cell, tmp_path, stages.append)
    assert not any("views:2" in stage or "training" in stage for stage in stages)
    expected = read_records(finished[0], finished[1][:1])
    assert list(map(without_clock, read_records(tmp_path))) == list(map(without_clock, expected))


@pytest.mark.full
def test_a_snapshot_that_fails_leaves_the_others_and_a_reason(room, tmp_path, capsys):
    (cell,) = make_cells(room, tmp_path, snapshots=("views:1", "views:2"))
    with pytest.raises(CellError, match="views:1"):
        run_cell(cell, tmp_path)
    assert snapshots_left(tmp_path, cell) == ("views:1",)
    told = paths_of(tmp_path, cell).error.read_text()
    assert "ViewsError" in told
    assert "in _train\n" in told  # where it failed, not only that it did
    assert "Traceback" not in "".join(capsys.readouterr())


@pytest.mark.full
@pytest.mark.parametrize("damage", ["a later version", "an image that is missing"])
def test_a_recorded_exploration_is_never_deleted(finished, room, tmp_path, damage):
    (cell,) = make_cells(room, tmp_path)
    run = paths_of(tmp_path, cell).run
    own_folder(paths_of(tmp_path, cell).folder, "cell")
    shutil.copytree(paths_of(finished[0], finished[1][0]).run, run)
    trace = run / "trace.jsonl"
    trace.write_bytes(b"".join(trace.read_bytes().splitlines(keepends=True)[:2]))  # cut off
    if damage == "a later version":
        header = json.loads((run / "run.json").read_text())
        (run / "run.json").write_text(json.dumps(header | {"version": 1000}))
    else:
        shutil.rmtree(run / "checkpoints")
        (run / "frames" / "000001.png").unlink()
    before = sorted(path for path in run.rglob("*") if path.is_file() and path.name != "lock")
    with pytest.raises((CellError, RunError), match="1000" if "later" in damage else "000001.png"):
        run_cell(cell, tmp_path)
    assert set(before) <= set(run.rglob("*"))


def test_a_scene_that_changed_meanwhile_is_refused(room, tmp_path):
    (cell,) = make_cells(room, tmp_path)
    other = dataclasses.replace(cell, scene_hash="0" * 64)
    with pytest.raises(CellError):
        run_cell(other, tmp_path)


def test_a_policy_that_changed_meanwhile_is_refused(room, tmp_path):
    (cell,) = make_cells(room, tmp_path)
    planned = dataclasses.replace(cell, sources={"my_policy.py": "0" * 64})
    with pytest.raises(CellError, match="random"):
        run_cell(planned, tmp_path)


def test_two_processes_do_not_work_on_one_cell(room, tmp_path, monkeypatch):
    (cell,) = make_cells(room, tmp_path)
    folder = paths_of(tmp_path, cell).folder
    folder.mkdir(parents=True)
    monkeypatch.setattr(module, "_LOCK_PATIENCE", 0.0)
    with module._lock(folder), pytest.raises(CellError, match="another process"):
        run_cell(cell, tmp_path)
