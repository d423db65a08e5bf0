"""The tables of frames on the way: what each row flies, and the numbers of a table by hand."""

from dataclasses import replace

import numpy as np
import pytest

from experiments import captures, flights
from experiments.captures import TABLES, Options, Row, as_line, quality_rows, rows_of
from experiments.suite import request_of
from r3jax.apps.benchmark.cells import paths_of, snapshots_left
from r3jax.apps.benchmark.record import read_records, write_record
from tests.evaluation.records import record as benchmark_record
from tests.formats.test_submissions import make_submission

ROWS = {
    "blind": Row("active-gs"),
    "seeing": Row("active-gs", "blind", loop={"capture_every": 0.3}),
}


AHEAD = "r3-ahead, a frame every 0.3 m"


def record(label, seed, psnr, views, **more):
    return {
        "policy": label, "settings": {}, "scene": "flat", "seed": seed,
        "views": {"psnr": psnr}, "exploration": {"views": views},
    } | more  # fmt: skip


@pytest.mark.parametrize("table", TABLES)
def test_each_row_can_be_flown_and_is_compared_with_a_row_of_its_table(table):
    base = request_of(Options(size="small"), "seconds").conditions
    cells = set()
    for row in TABLES[table].values():
        conditions = replace(base, clock="model", loop=dict(row.loop))
        policy = conditions.policy(row.policy, {})  # refuses what cannot work
        assert row.against in ("", *TABLES[table])
        cells.add((str(conditions), str(policy)))
    assert len(cells) == len(TABLES[table])  # no two rows are the same mission


def test_rows_are_chosen_by_name_and_by_policy():
    chosen = rows_of(Options(table="spacing", policies=("active-gs",)))
    assert {row.policy for row in chosen.values()} == {"active-gs"}
    assert list(rows_of(Options(table="spacing", rows=("active-gs",)))) == ["active-gs"]
    for wrong in ({"rows": ("asleep",)}, {"policies": ("random",)}):
        with pytest.raises(ValueError, match=next(iter(wrong.values()))[0] + "|spacing"):
            rows_of(Options(table="spacing", **wrong))


def test_a_line_per_row_by_hand():
    records = [
        record("blind", 0, [10.0, 20.0], 40),
        record("blind", 1, [12.0, 22.0], 50),
        record("seeing", 0, [18.0, 22.0], 90),
        record("seeing", 1, [20.0, 24.0], 110),
    ]
    blind, seeing = quality_rows(ROWS, records)
    assert blind == {
        "row": "blind", "flat": "16.00 [11.5] / 45", "mean": "16.00",
        "mean by seed": "15.00 / 17.00", "AUSE of R": "", "difference": "",
    }  # fmt: skip
    assert seeing["flat"] == f"21.00 [{np.mean([18.2, 20.2]):.1f}] / 100"
    assert seeing["difference"].startswith("+5.00 [")
    assert seeing["difference"].endswith("] to blind")
    assert "mean by seed" not in quality_rows(ROWS, [r for r in records if r["seed"] == 0])[0]


def test_what_rows_differ_in_on_purpose_is_no_unequal_term():
    plain = record("", 0, [1.0], 1, sensing={"fov": 60.0, "capture_every": 0.3}, training={"x": 1})
    line = as_line(plain, "seeing", ROWS)
    assert line["policy"] == "seeing"
    assert line["sensing"] == {"fov": 60.0}  # what they do not differ in stays to be checked
    assert line["training"] == {"x": 1}


def test_what_another_machine_made_is_not_run_again(tmp_path, monkeypatch):
    """A table of two seeds from records and poses of one that was made elsewhere."""
    terms = Options(table="rivals", rows=("gavis",), size="small", scenes=("flat",), out=tmp_path)
    monkeypatch.setattr(captures, "run_cells", lambda cells, root, **_: run.extend(cells))
    monkeypatch.setattr(flights, "submission_of_run", lambda run: make_submission(seed=1))
    monkeypatch.setattr(flights, "read_run", lambda path: path)
    monkeypatch.setattr(captures, "cost_rows", lambda root, cells: [])
    run = []

    def fly(options, seed, psnr):
        """Leaves what a run of that seed would leave."""
        root = options.work / "small-seconds"
        row = captures.TABLES["rivals"]["gavis"]
        (cell,) = captures.cells_of(replace(options, seeds=(seed,)), row, root)
        paths_of(root, cell).run.mkdir(parents=True)
        for snapshot in cell.conditions.snapshots:
            made = benchmark_record("gavis", "flat", seed, psnr=psnr) | {"snapshot": snapshot}
            made["run"] = paths_of(root, cell).run.relative_to(root).as_posix()
            write_record(paths_of(root, cell).record(snapshot), made)

    there = replace(terms, seeds=(0,), clock="wall", work=tmp_path / "a", out=tmp_path / "there")
    fly(there, 0, [10.0, 12.0])
    made_there = captures.main(there)
    name, flight = "rivals_records.jsonl", "rivals_flights/gavis_flat_0.jsonl"
    (made_there / flight).write_text("as it was flown there")

    here = replace(
        there,
        seeds=(0, 1),
        work=tmp_path / "b",
        out=tmp_path / "here",
        kept=(made_there / name,),
    )
    fly(here, 1, [20.0, 22.0])
    run.clear()
    folder = captures.main(here)
    assert all(snapshots_left(here.work / "small-seconds", cell) == () for cell in run)
    assert "11.00 / 21.00" in (folder / "rivals.md").read_text()
    assert (folder / flight).read_text() == "as it was flown there"
    assert (folder / "rivals_flights/gavis_flat_1.jsonl").exists()
    assert [(r["seed"], r["snapshot"]) for r in read_records(folder / name)] == [
        (seed, f"seconds:{seconds}") for seed in (0, 1) for seconds in (30, 60)
    ]
    # A table may take over what it holds itself.
    before = (folder / name).read_text()
    assert captures.main(replace(here, work=tmp_path / "c", kept=(folder / name,))) == folder
    assert (folder / name).read_text() == before
    assert (folder / flight).read_text() == "as it was flown there"
