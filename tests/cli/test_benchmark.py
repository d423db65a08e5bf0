"""`r3jax benchmark`, as a user meets it: a table at the end, nothing done twice, mistakes named."""

import csv
import io
import json
import os

import pytest

import r3jax
from r3jax.apps.benchmark import run_cell as running
from r3jax.apps.benchmark.record import CELLS
from r3jax.cli.commands.benchmark import beside, print_results
from r3jax.cli.console import Console
from r3jax.cli.main import main
from tests.evaluation.records import record

SMALL = {"policies": "random,frontier", "budget": "views:3", "clock": "model", "resolution": 32}
SMALL |= {"train-resolution": 32, "iterations": 30, "gaussians": 200, "capacity": 400}
SMALL |= {"test-views": 6, "lpips": "none", "voxel-size": 0.1, "fov": 90, "jobs": 0}


def benchmark(room, out, *words, **changes):
    options = {"scenes": room, "out": out} | SMALL
    options |= {name.replace("_", "-"): value for name, value in changes.items()}
    given = [word for name, value in options.items() for word in (f"--{name}", str(value))]
    settings = ["--settings", "num_candidates=10", "num_frontier=3"]
    return main(["benchmark", *given, *settings, *words])


@pytest.fixture(scope="module")
def finished(room, tmp_path_factory):
    """The folder of a finished benchmark of two cells with two snapshots each."""
    out = tmp_path_factory.mktemp("out")
    assert benchmark(room, out, snapshots="views:2,views:3") == 0
    return out


def read(out):
    return [json.loads(line) for line in (out / CELLS).read_text().splitlines()]


@pytest.mark.full
def test_every_cell_and_snapshot_has_its_line(finished):
    records = read(finished)
    assert sorted((r["policy"], r["snapshot"]) for r in records) == [
        (policy, snapshot)
        for policy in ("frontier", "random")
        for snapshot in ("views:2", "views:3")
    ]
    assert {r["settings"]["num_candidates"] for r in records} == {10}
    assert len({r["test_views"]["hash"] for r in records}) == 1
    for found in records:
        assert (finished / found["run"] / "run.json").exists()


@pytest.mark.full
def test_the_same_words_again_do_nothing_and_show_the_table(room, finished, monkeypatch, capsys):
    before = (finished / CELLS).read_bytes()
    monkeypatch.setattr(running, "run_cell", lambda *a, **k: pytest.fail("done a second time"))
    assert benchmark(room, finished, snapshots="views:2,views:3") == 0
    assert (finished / CELLS).read_bytes() == before
    captured = capsys.readouterr()
    assert "2 cells, 2" in captured.err
    for word in ("PSNR", "SSIM", "random", "frontier", "views:2", "views:3", "room"):
        assert word in captured.out


@pytest.mark.full
@pytest.mark.parametrize("form", ["csv", "latex", "markdown"])
def test_tables_are_printed_for_other_programs(room, finished, capsys, form):
    words = ("--format", form, "--reference", "random")
    assert benchmark(room, finished, *words, snapshots="views:2,views:3") == 0
    text = capsys.readouterr().out
    if form != "csv":
        begin = {"latex": r"\begin{table}", "markdown": "| method |"}[form]
        assert text.count(begin) == 4  # quality and costs, at two snapshots
        return
    lines = list(csv.DictReader(io.StringIO(text)))
    assert [(line["terms"], line["scene"], line["method"]) for line in lines] == [
        (snapshot, "room", policy)
        for snapshot in ("views:2", "views:3")
        for policy in ("random", "frontier")
    ]
    for line in lines:
        (found,) = (
            r for r in r3jax.read_records(finished)
            if (r["policy"], r["snapshot"]) == (line["method"], line["terms"])
        )  # fmt: skip
        assert float(line["PSNR [dB]"]) == pytest.approx(found["metrics"]["psnr"]["mean"])
        assert float(line["decision [ms]"]) == found["measured"]["decision_ms"] > 0.0
        assert (line["minus reference"] == "") == (line["method"] == line["reference"] == "random")


@pytest.mark.full
def test_every_value_of_a_sweep_makes_a_cell(room, tmp_path, capsys):
    words = ("--sweep", "lambda2=0.2,0.8")
    assert benchmark(room, tmp_path, *words, policies="r3-pano", seeds="0,1") == 0
    found = sorted((r["settings"]["lambda2"], r["seed"]) for r in read(tmp_path))
    assert found == [(0.2, 0), (0.2, 1), (0.8, 0), (0.8, 1)]
    out = capsys.readouterr().out
    assert "r3-pano (lambda2=0.2)" in out
    assert "r3-pano (lambda2=0.8)" in out


@pytest.mark.full
def test_another_setting_makes_another_cell_beside_the_first(room, finished, capsys):
    before = read(finished)
    assert benchmark(room, finished, policies="random", snapshots="views:2", iterations=20) == 0
    after = read(finished)
    assert len(after) == len(before) + 1
    assert all(record in after for record in before)
    captured = capsys.readouterr()
    assert "1 cells, 0" in captured.err
    assert "1/1 done" in captured.err
    assert "frontier (" not in captured.out  # the table is of what was asked for


@pytest.mark.full
def test_a_cell_that_fails_is_named_and_the_exit_code_says_so(room, tmp_path, capsys, monkeypatch):
    evaluate = running.evaluate

    def judge_one(*args, **kwargs):
        if len(list(tmp_path.glob("cells/*/snapshot-*.json"))) == 1:
            raise ArithmeticError("a bad day")
        return evaluate(*args, **kwargs)

    monkeypatch.setattr(running, "evaluate", judge_one)
    assert benchmark(room, tmp_path) == 1
    error = capsys.readouterr().err
    assert "failed   room-frontier-seed0-" in error
    assert "a bad day" in error
    assert [record["policy"] for record in read(tmp_path)] == ["random"]
    monkeypatch.undo()
    assert benchmark(room, tmp_path) == 0
    assert len(read(tmp_path)) == 2


def test_a_folder_that_cannot_be_written_gets_one_line(room, tmp_path, capsys):
    (tmp_path / "file").touch()
    assert benchmark(room, tmp_path / "file" / "out") == 2
    assert f"{os.sep}file" in capsys.readouterr().err


def submitted(name, version=0, **changes):
    """The record of a submission; another `version` is a corrected one of the same name."""
    return record(views=6, **changes) | {"policy": f"{name} (submitted)", "commit": str(version)}


def shown(records):
    console = Console(file=io.StringIO(), width=200)
    print_results(console, records)
    return console.file.getvalue()


def test_a_corrected_submission_does_not_keep_others_from_their_table():
    alice, corrected, bob = submitted("alice"), submitted("alice", 1), submitted("bob")
    chosen = beside([bob], [alice, corrected, bob])
    assert chosen == [bob, alice, corrected]
    told = shown(chosen)
    assert told.count("alice (submitted)") == 4  # in two tables of each group
    assert "table 2 on the same terms" in told
    assert beside([corrected], [alice, corrected, bob]) == [corrected, alice, bob]


def test_submissions_on_different_terms_have_tables_of_their_own():
    bob, carol = submitted("bob"), submitted("carol", resolution=512)
    near, far = submitted("dave", resolution=512), submitted("erin", resolution=128)
    chosen = beside([bob, carol], [near, far])
    assert chosen == [bob, carol, near]  # on the terms of one that was asked for
    told = shown(chosen)
    assert "exploration: 256" in told
    assert "exploration: 512" in told
