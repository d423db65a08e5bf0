"""The benchmark's tables and figures from records by hand; the sizes of the suite."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments import degeneracy, paper
from experiments.pages.artifacts import Origin
from experiments.suite import HOUSE, take_over
from r3jax.apps.benchmark.cells import Cell, Conditions, paths_of, snapshots_left
from r3jax.apps.benchmark.record import read_records, write_record, write_records
from r3jax.runs.writer import RunWriter
from r3jax.simulators.scenes.registry import open_world
from tests.evaluation.records import record
from tests.runs.runs import make_header, make_view

SOURCE = Origin("python -m experiments.some", "a machine", "abc")
ROOT = Path(__file__).parents[2]
POLICIES = ("random", "active-gs", "r3", "r3-pano")


@pytest.fixture(scope="module")
def records():
    return [
        record(policy, scene, seed, snapshot)
        for policy in POLICIES
        for scene in ("flat", "office")
        for seed in (0, 1)
        for snapshot in (30, 60)
    ]


def data_of(path):
    lines = path.read_text().splitlines()
    assert lines[0] == f"# command: {SOURCE.command}"
    return list(csv.DictReader(line for line in lines if not line.startswith("#")))


def test_a_table_of_equal_views_keeps_its_records_and_poses(tmp_path, monkeypatch):
    """Flights are called as their policy; those of another machine come from beside its table."""
    cells = [
        Cell(scene, "a", policy, 0, Conditions(), "b", 9)
        for policy in ("r3", "random")
        for scene in ("flat", "office")
    ]
    made = [record(cell.policy, cell.scene, 0, 30) for cell in cells]
    monkeypatch.setattr(paper, "run_requests", lambda *_: (tmp_path / "a", cells, made))
    there = tmp_path / "there/some_flights"
    there.mkdir(parents=True)
    names = {f"{cell.policy}_{cell.scene}_0.jsonl" for cell in cells}
    for name in names:
        (there / name).write_text(name)
    monkeypatch.setitem(paper.NAMES, "views", "some")
    options = paper.Options(kept=(tmp_path / "there/some_records.jsonl",), out=tmp_path / "out")
    folder = paper.main(options)
    assert {path.name: path.read_text() for path in (folder / "some_flights").iterdir()} == {
        name: name for name in names
    }
    assert len((folder / "some_records.jsonl").read_text().splitlines()) == len(cells)


def test_records_of_other_terms_find_no_place(tmp_path):
    """What a cell lacks is taken over from a file; what it has stays, and others change nothing."""
    conditions = Conditions(snapshots=("views:30", "views:60"))
    cells = [Cell("flat", "a", "r3", seed, conditions, "b", 9) for seed in (0, 1)]

    def made(cell, snapshot, psnr):
        run = paths_of(tmp_path, cell).run.relative_to(tmp_path).as_posix()
        return record("r3", "flat", cell.seed, snapshot, psnr=psnr) | {"run": run}

    longer = replace(cells[1], conditions=replace(conditions, iterations=9))
    elsewhere = [made(cells[0], 30, [1.0]), made(cells[0], 60, [2.0]), made(longer, 30, [3.0])]
    write_records(tmp_path / "records.jsonl", elsewhere)
    paths_of(tmp_path, cells[0]).folder.mkdir(parents=True)
    write_record(paths_of(tmp_path, cells[0]).record("views:30"), made(cells[0], 30, [9.0]))
    take_over([tmp_path / "records.jsonl"], tmp_path, cells)
    assert [r["views"]["psnr"] for r in read_records(tmp_path, cells)] == [[9.0], [2.0]]
    assert [snapshots_left(tmp_path, cell) for cell in cells] == [(), conditions.snapshots]


def test_tables_hold_the_last_snapshot(records, tmp_path):
    paper.write_tables(tmp_path, "page", records, SOURCE)
    page = (tmp_path / "page.md").read_text()
    assert SOURCE.commit in page
    for kind in ("quality", "tails", "differences"):
        assert "\\toprule" in (tmp_path / f"{kind}.tex").read_text()
    rows = data_of(tmp_path / "quality.csv")
    chosen = [r for r in records if r["policy"] == "r3" and r["snapshot"] == "views:60"]
    expected = np.mean([r["views"]["psnr"] for r in chosen if r["scene"] == "flat"])
    (found,) = [r for r in rows if r["method"] == "r3" and r["metric"].startswith("PSNR")]
    assert float(found["flat"]) == pytest.approx(expected, abs=1e-6)
    without = [r for r in records if r["policy"] != "r3-pano"]
    assert "differences" not in paper.tables_of(without[1::2])


def test_what_captured_while_moving_has_tables_of_its_own(records):
    moving = [
        r | {"policy": "r3-ahead", "sensing": r["sensing"] | {"capture_every": 0.3}}
        for r in records if r["policy"] == "r3"
    ]  # fmt: skip
    last = [r for r in [*records, *moving] if r["snapshot"] == "views:60"]
    tables = paper.tables_of(last)
    assert {row.labels[0] for row in tables["quality"].rows} == set(POLICIES)
    assert {row.labels[0] for row in tables["quality-1"].rows} == {"r3-ahead"}
    assert "differences-1" not in tables


def test_the_size_of_the_paper_has_five_snapshots_in_the_flat():
    requests = paper.requests_of(paper.Options(size="paper", unit="seconds"))
    terms = [(r.scenes[0], r.policies, r.conditions) for r in requests]
    assert [(scene, len(c.snapshots)) for scene, _, c in terms[:3]] == [
        ("flat", 5), ("flat", 5), ("office", 3),
    ]  # fmt: skip
    assert {c.budget for *_, c in terms} == {"seconds:300"}
    for scene, policies, conditions in terms:
        assert (policies == ("r3-ahead",)) == bool(conditions.exploration_config().captures), scene


def test_the_page_of_the_budget_shows_all_its_pictures(records, tmp_path):
    paper.write_curves(tmp_path, records, SOURCE)
    page = (tmp_path / "curves.md").read_text()
    for name in (*paper.CURVES, "psnr_by_view"):
        assert f"({name}.png)" in page
        assert (tmp_path / f"{name}.png").exists()
    assert {row["method"] for row in data_of(tmp_path / "areas.csv")} == set(POLICIES)


def poses(places, directions):
    found = np.tile(np.eye(4), (len(places), 1, 1))
    found[:, :3, 3], found[:, :3, 2] = places, directions
    return found


def test_revisits_by_hand():
    x, y = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]
    turned = [np.cos(0.5), np.sin(0.5), 0.0]  # 29 degrees from x
    here, near, far = [0.0, 0.0, 0.0], [0.0, 0.0, 0.45], [0.0, 0.0, 0.95]
    assert degeneracy.revisit_rate(poses([here], [x])) == 0.0
    assert degeneracy.revisit_rate(poses([here, near], [x, turned])) == 1.0
    assert degeneracy.revisit_rate(poses([here, near], [x, y])) == 0.0
    assert degeneracy.revisit_rate(poses([here, far], [x, x])) == 0.0
    # The third is far from the first, near the second; the fourth is new.
    chain = poses([here, near, [0.0, 0.0, 0.9], here], [x, x, x, y])
    assert degeneracy.revisit_rate(chain) == pytest.approx(2 / 3)


def test_positions_come_from_the_runs_up_to_the_snapshot(tmp_path):
    with RunWriter(tmp_path / "run", make_header()) as writer:
        for step in range(3):
            writer.add(*make_view(step))
    taken = [record(policy, snapshot=2, budget=2) | {"run": "run"} for policy in POLICIES[:2]]
    found = degeneracy.missions(tmp_path, taken)
    assert [len(mission["poses"]) for mission in found] == [2, 2]
    degeneracy.write_page(tmp_path / "out", tmp_path, taken, SOURCE)
    rows = data_of(tmp_path / "out" / "missions.csv")
    assert [row["policy"] for row in rows] == list(POLICIES[:2])
    assert float(rows[0]["revisit_rate"]) == degeneracy.revisit_rate(found[0]["poses"])
    assert (tmp_path / "out" / "flat.png").exists()
    page = (tmp_path / "out" / "degeneracy.md").read_text()
    assert "| random |" in page.replace("| random  ", "| random ")


@pytest.mark.full
def test_the_house_of_the_tables_comes_with_the_repository(monkeypatch):
    monkeypatch.chdir(ROOT)
    files = list((ROOT / "experiments/results").rglob("*_records.jsonl"))
    rows = [row for path in files for row in read_records(path)]
    hashes = {row["scene_hash"] for row in rows if row["scene"] == "aws_small_house"}
    assert hashes == {open_world(HOUSE).content_hash}
