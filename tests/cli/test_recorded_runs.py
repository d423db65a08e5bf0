"""Resume, fork, replay and merge, as a user meets them."""

import json
import shutil
import subprocess

import jax
import numpy as np
import pytest

from r3jax.cli.main import main
from r3jax.mapping.join import grow, merge
from r3jax.runs.reader import read_run
from r3jax.runs.replay import rebuild
from tests.cli.small_runs import explore, main_without_report

pytestmark = pytest.mark.full

VIEWS = 5


@pytest.fixture(scope="module")
def runs(room, tmp_path_factory):
    """`whole` has five views, `part` the first three of them, `other` another seed."""
    out = tmp_path_factory.mktemp("runs")
    budget = ("--budget", f"views:{VIEWS}")
    assert explore(room, out, "--name", "whole", *budget) == 0
    assert explore(room, out, "--name", "part") == 0
    assert explore(room, out, "--name", "other", "--seed", "1") == 0
    return out


@pytest.fixture
def part(runs, tmp_path):
    return shutil.copytree(runs / "part", tmp_path / "part")


def poses_of(path):
    return np.stack([row.pose for row in read_run(path).rows])


def test_a_resumed_run_is_the_whole_run(runs, part, capsys):
    assert main(["explore", "--resume", str(part), "--budget", f"views:{VIEWS}"]) == 0
    assert "view 3" in capsys.readouterr().err
    for name in ("trace.jsonl", "transforms.json", "frames/000004.depth.png", "run.json"):
        assert (part / name).read_bytes() == (runs / "whole" / name).read_bytes(), name
    assert (part / "report" / "report.html").exists()


def test_without_another_budget_a_finished_run_stays_as_it_is(part):
    before = (part / "trace.jsonl").read_bytes()
    assert main_without_report(["explore", "--resume", str(part)]) == 0
    assert (part / "trace.jsonl").read_bytes() == before


def test_a_fork_keeps_the_first_views_and_goes_its_own_way(runs, tmp_path):
    words = ["--at", "2", "--out", str(tmp_path), "--budget", f"views:{VIEWS}"]
    fork = ["explore", "--fork", str(runs / "whole"), *words]
    assert main_without_report([*fork, "--policy", "frontier", "--candidates", "20"]) == 0
    run = read_run(tmp_path / "whole-frontier-from2")
    assert len(run.rows) == VIEWS
    before, after = poses_of(runs / "whole"), poses_of(run.path)
    np.testing.assert_array_equal(after[:2], before[:2])
    assert np.abs(after[2:] - before[2:]).max() > 0.1
    assert run.header.policy["name"] == "frontier"
    assert run.header.parent == {"forked": str(runs / "whole"), "views": 2, "decided_from": 2}
    assert len(list(run.frames())) == VIEWS


def test_a_fork_by_the_same_policy_repeats_the_run(runs, tmp_path):
    words = ["--at", "3", "--out", str(tmp_path), "--name", "same"]
    assert main_without_report(["explore", "--fork", str(runs / "whole"), *words]) == 0
    trace = (tmp_path / "same" / "trace.jsonl").read_bytes()
    assert trace == (runs / "whole" / "trace.jsonl").read_bytes()


def test_a_fork_that_is_cut_off_goes_on(runs, tmp_path):
    words = ["--at", "2", "--out", str(tmp_path), "--policy", "frontier", "--candidates", "20"]
    fork = ["explore", "--fork", str(runs / "whole"), *words]
    assert main_without_report([*fork, "--name", "long", "--budget", f"views:{VIEWS}"]) == 0
    assert main_without_report([*fork, "--name", "short", "--budget", "views:3"]) == 0
    shutil.rmtree(tmp_path / "short" / "checkpoints")
    assert (
        main_without_report(
            ["explore", "--resume", str(tmp_path / "short"), "--budget", f"views:{VIEWS}"]
        )
        == 0
    )
    trace = (tmp_path / "short" / "trace.jsonl").read_bytes()
    assert trace == (tmp_path / "long" / "trace.jsonl").read_bytes()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--resume", "{part}", "--resolution", "32"], "--resolution"),
        (["--resume", "{part}", "--policy", "frontier"], "--policy"),
        (["--resume", "{part}", "--fork", "{part}", "--at", "1"], "--fork"),
        (["--resume", "{part}", "--budget", "views:0"], "budget"),
        (["--resume", "{part}/frames"], "frames"),
        (["--fork", "{part}", "--at", "4"], "got 4"),
        (["--fork", "{part}", "--at", "1", "--scene", "flat"], "--scene"),
        ([], "--scene"),
    ],
)
def test_a_mistake_is_named_and_changes_nothing(part, capsys, words, message):
    before = {p: p.read_bytes() for p in part.rglob("*") if p.is_file() and p.name != "lock"}
    assert main_without_report(["explore", *(word.format(part=part) for word in words)]) == 2
    assert message in capsys.readouterr().err
    after = {p: p.read_bytes() for p in part.rglob("*") if p.is_file() and p.name != "lock"}
    assert after == before


def test_another_scene_under_the_same_name_is_noticed(room, part, capsys):
    header = json.loads((part / "run.json").read_text())
    header["scene"]["hash"] = "0" * 64
    del header["seal"]
    (part / "run.json").write_text(json.dumps(header))
    assert main_without_report(["explore", "--resume", str(part)]) == 2
    assert "run.json" in capsys.readouterr().err


def test_other_versions_are_told(part, capsys):
    header = json.loads((part / "run.json").read_text())
    header["packages"]["jax"] = "0.1"
    del header["seal"]
    (part / "run.json").write_text(json.dumps(header))
    assert main_without_report(["explore", "--resume", str(part)]) == 0
    assert "jax 0.1" in capsys.readouterr().err


@pytest.fixture
def read_only(part):
    """The run on a file system that nobody can write."""
    mount = ["mount", "--bind", str(part), str(part)]
    remount = ["mount", "-o", "remount,ro,bind", str(part)]
    if any(subprocess.run(words, capture_output=True).returncode for words in (mount, remount)):
        subprocess.run(["umount", str(part)], capture_output=True)
        pytest.skip("needs the right to mount a file system")
    yield part
    subprocess.run(["umount", str(part)], check=True)


def test_a_read_only_run_can_be_read_and_replayed_but_not_gone_on_with(read_only, capsys):
    assert main(["info", str(read_only)]) == 0
    assert main(["replay", str(read_only)]) == 0
    capsys.readouterr()
    assert main_without_report(["explore", "--resume", str(read_only), "--budget", "views:4"]) == 2
    assert "Read-only file system" in capsys.readouterr().err


def test_a_replay_finds_the_stored_map(runs, capsys):
    assert main(["replay", str(runs / "whole")]) == 0
    assert "5 frames" in capsys.readouterr().err


def test_a_replay_notices_a_map_that_the_frames_do_not_give(runs, part, capsys):
    """The checkpoint of the whole run, put into the run of three views as its last."""
    shutil.rmtree(part / "checkpoints" / "000002")
    shutil.copytree(runs / "whole" / "checkpoints" / "000004", part / "checkpoints" / "000002")
    assert main(["replay", str(part)]) == 1
    errors = capsys.readouterr().err
    assert "map.count: " in errors
    assert "grid.log_odds: " in errors


def test_a_merged_run_has_seen_what_both_have_seen(runs, tmp_path):
    out = tmp_path / "both"
    first, second = read_run(runs / "whole"), read_run(runs / "other")
    assert main(["merge", str(first.path), str(second.path), "--out", str(out)]) == 0
    run = read_run(out)
    assert [row.step for row in run.rows] == list(range(VIEWS + 3))
    np.testing.assert_array_equal(
        poses_of(out), np.concatenate([poses_of(first.path), poses_of(second.path)])
    )
    assert len(list(run.frames())) == VIEWS + 3
    assert run.rows[-1].metres == first.rows[-1].metres + second.rows[-1].metres
    assert len(json.loads((out / "transforms.json").read_text())["frames"]) == VIEWS + 3
    assert main(["replay", str(out)]) == 0
    _, merged, grid = run.checkpoint()
    maps = [rebuild([r]).map_state for r in (first, second)]
    joined = merge(grow(maps[0], merged.capacity), maps[1])
    assert int(merged.num_occupied) == int(joined.num_occupied)
    assert float(merged.count.sum()) == float(joined.count.sum())
    known = lambda grid: int((grid.free | grid.occupied).sum())
    assert known(grid) >= max(known(rebuild([r]).grid) for r in (first, second))


def test_a_run_is_not_merged_with_itself(runs, tmp_path, capsys):
    (tmp_path / "link").symlink_to(runs / "whole")
    for other in (runs / "whole", tmp_path / "link"):
        words = ["merge", str(runs / "whole"), str(other), "--out", str(tmp_path / "twice")]
        assert main(words) == 2
    assert not (tmp_path / "twice").exists()


def test_resuming_repairs_the_last_map(runs, part, capsys):
    whole = read_run(part).load_checkpoint(2)
    files = (p for p in (part / "checkpoints" / "000002").rglob("*") if p.is_file())
    largest = max(files, key=lambda p: p.stat().st_size)
    data = bytearray(largest.read_bytes())
    data[len(data) // 2] ^= 1
    largest.write_bytes(data)
    assert main(["replay", str(part)]) == 2
    assert "000002" in capsys.readouterr().err
    assert main_without_report(["explore", "--resume", str(part)]) == 0
    jax.tree.map(np.testing.assert_array_equal, read_run(part).load_checkpoint(2), whole)


def test_a_merged_run_is_forked_not_resumed(runs, tmp_path, capsys):
    out = tmp_path / "both"
    assert main(["merge", str(runs / "part"), str(runs / "other"), "--out", str(out)]) == 0
    assert main_without_report(["explore", "--resume", str(out)]) == 2
    assert "--fork" in capsys.readouterr().err
    words = ["--at", "6", "--budget", "views:7", "--policy", "random", "--candidates", "20"]
    assert main_without_report(["explore", "--fork", str(out), *words, "--out", str(tmp_path)]) == 0
    assert len(read_run(tmp_path / "both-random-from6").rows) == 7


def test_a_merged_run_merges_again(runs, tmp_path):
    paths = [str(runs / name) for name in ("part", "other", "whole")]
    assert main(["merge", *paths[:2], "--out", str(tmp_path / "two")]) == 0
    assert main(["merge", str(tmp_path / "two"), paths[2], "--out", str(tmp_path / "three")]) == 0
    assert main(["replay", str(tmp_path / "three")]) == 0
    run = read_run(tmp_path / "three")
    assert run.header.parent["merged_views"] == [3, 3, VIEWS]
    cells = rebuild([read_run(path) for path in paths]).grid
    np.testing.assert_array_equal(run.checkpoint()[2].log_odds, cells.log_odds)


def test_a_fork_that_was_cut_off_while_it_took_views_over_is_refused(runs, tmp_path, capsys):
    words = ["--at", "3", "--out", str(tmp_path), "--name", "fork", "--budget", "views:3"]
    assert main_without_report(["explore", "--fork", str(runs / "part"), *words]) == 0
    trace = tmp_path / "fork" / "trace.jsonl"
    trace.write_bytes(b"".join(trace.read_bytes().splitlines(keepends=True)[:2]))
    assert main_without_report(["explore", "--resume", str(tmp_path / "fork")]) == 2
    assert "2 of the 3 views" in capsys.readouterr().err


def test_an_interrupt_that_nobody_catches_is_no_traceback(part, monkeypatch, capsys):
    def interrupted(run, on_frame):
        raise KeyboardInterrupt

    monkeypatch.setattr("r3jax.cli.commands.runs.differences", interrupted)
    assert main(["replay", str(part)]) == 130
    assert "r3jax: interrupted" in capsys.readouterr().err


def test_views_and_frames_on_the_way_are_counted_apart(room, tmp_path, capsys):
    """Three views and some frames between them, twice."""
    for name, seed in (("a", "0"), ("b", "1")):
        words = ["--name", name, "--seed", seed, "--capture-every", "0.1", "--gaze", "ahead"]
        assert explore(room, tmp_path, *words) == 0
    captured = [len(read_run(tmp_path / name).rows) - 3 for name in ("a", "b")]
    assert min(captured) > 0
    counts = [f"3 views and {num} frames captured while moving" for num in captured]
    capsys.readouterr()
    assert main_without_report(["explore", "--resume", str(tmp_path / "a")]) == 0
    assert counts[0] in capsys.readouterr().err
    assert main(["merge", str(tmp_path / "a"), str(tmp_path / "b")]) == 0
    assert f"{counts[0]} + {counts[1]}, " in capsys.readouterr().err
    assert main(["forecast", str(tmp_path / "a")]) == 0
    lines = capsys.readouterr().out.splitlines()
    start = lines.index("views  frames   mean   p10   p50")
    told = [line.split() for line in lines[start + 1 : start + 4]]
    assert [words[0] for words in told] == ["1", "2", "3"]
    assert told[-1][1] == str(3 + captured[0])
    fork = ["explore", "--fork", str(tmp_path / "a"), "--at", "99"]
    assert main_without_report(fork) == 2
    assert f"the run's {3 + captured[0]} frames, got 99" in capsys.readouterr().err


def test_runs_of_different_terms_do_not_merge(room, runs, tmp_path, capsys):
    assert explore(room, tmp_path, "--max-range", "3") == 0
    assert main(["merge", str(runs / "part"), str(tmp_path / "box")]) == 2
    assert "max_range" in capsys.readouterr().err
