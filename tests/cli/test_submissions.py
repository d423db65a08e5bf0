"""Submissions, as a user meets them: exported, checked, judged beside the policies."""

import json

import pytest

from r3jax.apps.benchmark.record import CELLS
from r3jax.cli.main import main
from tests.cli.small_runs import explore

pytestmark = pytest.mark.full

JUDGING = ["--train-resolution", "48", "--iterations", "30", "--gaussians", "200"]
JUDGING += ["--capacity", "400", "--test-views", "6", "--lpips", "none", "--jobs", "0"]


@pytest.fixture(scope="module")
def exported(room, tmp_path_factory):
    """A submission of three views."""
    out = tmp_path_factory.mktemp("runs")
    assert explore(room, out) == 0
    path = out / "box.jsonl"
    assert main(["export", str(out / "box"), "--format", "submission", "--out", str(path)]) == 0
    return path


def header(path):
    return json.loads(path.read_text().splitlines()[0])


def damaged(path, tmp_path, line, **fields):
    """A copy of a submission in which some fields of a line are others."""
    lines = [json.loads(text) for text in path.read_text().splitlines()]
    lines[line] |= fields
    other = tmp_path / "damaged.jsonl"
    other.write_text("".join(json.dumps(plain) + "\n" for plain in lines))
    return other


def test_a_submission_takes_some_kilobytes_and_is_in_order(exported, capsys):
    assert exported.stat().st_size < 4000
    assert main(["benchmark", "--submission", str(exported), "--check"]) == 0
    assert "3 frames" in capsys.readouterr().err


def test_a_check_says_all_that_is_wrong_and_fails(exported, tmp_path, capsys):
    late = damaged(exported, tmp_path, 2, seconds=0.1, mapping=0.0)
    torn = tmp_path / "torn.jsonl"
    torn.write_bytes(exported.read_bytes()[:-40])
    words = ["--submission", str(late), str(torn), str(exported), "--check"]
    assert main(["benchmark", *words]) == 1
    told = " ".join(capsys.readouterr().err.split())
    assert "damaged.jsonl, line 3, frame 1: `mapping`" in told
    assert "damaged.jsonl, line 3, frame 1: `seconds`" in told
    assert "torn.jsonl: line 4" in told
    assert "3 frames" in told


def test_the_mesh_of_a_submission_may_lie_elsewhere(room, exported, tmp_path, capsys):
    away = damaged(exported, tmp_path, 0, scene=header(exported)["scene"] | {"name": "mesh:x.ply"})
    words = ["benchmark", "--submission", str(away), "--check"]
    assert main(words) == 1
    assert "x.ply" in capsys.readouterr().err
    assert main([*words, "--scenes", room]) == 0


def test_a_submission_stands_in_the_table_beside_a_policy(room, exported, tmp_path, capsys):
    terms = ["--budget", "views:3", "--clock", "model", "--resolution", "48", "--fov", "90"]
    terms += ["--voxel-size", "0.1", "--policies", "frontier", "--scenes", room]
    terms += ["--settings", "num_candidates=10", "num_frontier=3"]
    assert main(["benchmark", *terms, *JUDGING, "--out", str(tmp_path)]) == 0
    capsys.readouterr()
    words = ["benchmark", "--submission", str(exported), *JUDGING, "--out", str(tmp_path)]
    assert main(words) == 0
    captured = capsys.readouterr()
    assert "3 of 3" in captured.err
    assert "random (submitted)" in captured.out
    assert "frontier" in captured.out
    records = [json.loads(line) for line in (tmp_path / CELLS).read_text().splitlines()]
    assert {record["policy"] for record in records} == {"frontier", "random (submitted)"}
    assert main([*words[:-2], "--iterations", "20", "--out", str(tmp_path)]) == 0
    assert "frontier" not in capsys.readouterr().out  # its training was another


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--submission", "{it}", "{it}"], "policy.name"),
        (["--submission", "{bad}"], "hash"),
        (["--submission", "{it}", "--train-resolution", "64"], "train_resolution 64"),
        (["--submission", "{it}", "--snapshots", "views:9"], "views:9"),
    ],
)
def test_a_mistake_gets_one_line_and_judges_nothing(exported, tmp_path, capsys, words, message):
    lines = exported.read_text().splitlines()
    first = json.loads(lines[0])
    first["scene"]["hash"] = "0" * 64
    bad = tmp_path / "bad.jsonl"
    bad.write_text("\n".join([json.dumps(first), *lines[1:]]))
    given = [word.format(it=exported, bad=bad) for word in words]
    judging = [] if "--train-resolution" in given else JUDGING
    assert main(["benchmark", *given, *judging, "--out", str(tmp_path / "out")]) == 2
    told = [x for x in capsys.readouterr().err.splitlines() if x.startswith("r3jax:")]
    assert len(told) == 1
    assert message in told[0]
    assert not (tmp_path / "out" / "cells").exists()


def test_a_submission_is_not_written_over_a_file(exported, capsys):
    run = exported.parent / "box"
    before = exported.read_bytes()
    assert main(["export", str(run), "--format", "submission", "--out", str(exported)]) == 2
    assert str(exported) in capsys.readouterr().err
    assert exported.read_bytes() == before


def test_a_submission_may_be_written_into_a_new_folder(exported, tmp_path):
    path = tmp_path / "a" / "b" / "box.jsonl"
    words = ["export", str(exported.parent / "box"), "--format", "submission", "--out", str(path)]
    assert main(words) == 0
    assert path.read_bytes() == exported.read_bytes()


def test_a_corrected_submission_and_other_terms_break_no_table(exported, tmp_path, capsys):
    policy, scene = header(exported)["policy"], header(exported)["scene"]
    last = json.loads(exported.read_text().splitlines()[-1])
    for name in ("corrected", "bob", "carol"):
        (tmp_path / name).mkdir()
    corrected = damaged(exported, tmp_path / "corrected", -1, seconds=last["seconds"] + 0.5)
    bob = damaged(exported, tmp_path / "bob", 0, policy=policy | {"name": "bob"})
    carol = damaged(
        exported, tmp_path / "carol", 0,
        policy=policy | {"name": "carol"}, scene=scene | {"noise": 0.0},
    )  # fmt: skip
    words = ["benchmark", *JUDGING, "--out", str(tmp_path / "out"), "--submission"]
    for paths in ([exported], [corrected]):
        assert main([*words, *map(str, paths)]) == 0
    capsys.readouterr()
    assert main([*words, str(bob), str(carol)]) == 0
    told = capsys.readouterr().out
    assert told.count("random (submitted)") == 2
    assert "table 2 on the same terms" in told
    assert "the exploration's noise: 0.0" in told
