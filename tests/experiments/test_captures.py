"""The tables of frames on the way: what each row flies, and the numbers of a table by hand."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure

from experiments import captures, flights
from experiments.captures import TABLES, Options, Row, as_line, quality_rows, rows_of, run_in_turn
from experiments.pages.artifacts import Origin
from experiments.suite import request_of
from r3jax.apps.benchmark.cells import Cell, Conditions, paths_of, snapshots_left
from r3jax.apps.benchmark.record import read_lines, write_record
from r3jax.planning.registry import make_policy
from tests.evaluation.records import record as benchmark_record
from tests.formats.test_submissions import make_submission

ROWS = {
    "blind": Row("active-gs"),
    "seeing": Row("active-gs", "blind", loop={"capture_every": 0.3}),
}


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
        conditions = replace(base, clock="model", loop=dict(row.loop), **row.training)
        policy = conditions.policy(row.policy, dict(row.planner))  # refuses what cannot work
        assert row.against in ("", *TABLES[table])
        cells.add((conditions.loop.get("gaze"), str(conditions), str(policy)))
    assert len(cells) == len(TABLES[table])  # no two rows are the same mission


def test_rows_are_chosen_by_name_and_by_policy():
    assert set(rows_of(Options(table="turning", policies=("active-gs",)))) == {
        "active-gs", "active-gs, captures, plans on the way",
    }  # fmt: skip
    assert list(rows_of(Options(table="gaze", rows=("ahead",)))) == ["ahead"]
    with pytest.raises(ValueError, match="'asleep' is none of"):
        rows_of(Options(table="gaze", rows=("asleep",)))
    with pytest.raises(ValueError, match="has no row of"):
        rows_of(Options(table="gaze", policies=("random",)))


def test_the_cells_of_ours_pano_are_the_weight_that_its_swap_takes_over():
    """The part that `r3con` is measured without is the one that `r3-pano` has."""
    swapped = TABLES["r3con"]["r3con, 16 for a cell instead of 1000"].planner["cell_weight"]
    assert swapped == float(make_policy("r3-pano").config.scoring.lambda1)
    fixed = TABLES["r3con"]["r3con, path weight 0.5 instead of adaptive"].planner["path_weight"]
    assert fixed == make_policy("r3-pano").config.lambda2
    theirs = make_policy("r3con").config
    candidates = TABLES["r3con"]["r3-pano, candidates of r3con"].planner
    assert candidates == {name: getattr(theirs, name) for name in candidates}


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


def test_ause_tells_how_well_r_ranks_the_test_views():
    """Nothing where R has the order of the errors; 2 where it has the opposite one, 1 is chance."""
    psnr = [10.0, 20.0, 30.0]
    for order, area in (([0.1, 0.2, 0.3], "0.00"), ([0.3, 0.2, 0.1], "2.00")):
        ranked = record("blind", 0, psnr, 4)
        ranked["views"]["renderability"] = order
        (line,) = quality_rows({"blind": ROWS["blind"]}, [ranked])
        assert line["AUSE of R"] == area


def test_what_rows_differ_in_on_purpose_is_no_unequal_term():
    plain = record("", 0, [1.0], 1, sensing={"fov": 60.0, "capture_every": 0.3}, training={"x": 1})
    line = as_line(plain, "seeing", ROWS)
    assert line["policy"] == "seeing"
    assert line["sensing"] == {"fov": 60.0}  # what they do not differ in stays to be checked
    assert line["training"] == {"x": 1}


def test_what_differs_in_its_training_only_takes_over_the_flight(tmp_path, monkeypatch):
    short, long, other = (
        Cell("flat", "a", "r3", seed, Conditions(iterations=iterations), "b", 9)
        for seed, iterations in ((0, 1500), (0, 6000), (1, 1500))
    )
    flown = []

    def fly(cells, root, **kwargs):
        for cell in cells:
            run = paths_of(root, cell).run
            if not run.exists():
                flown.append(cell)
                (run / "models").mkdir(parents=True)
                (run / "frame.png").write_bytes(cell.identity_hash.encode())

    monkeypatch.setattr(captures, "run_cells", fly)
    run_in_turn([short, long, other], Path(tmp_path), Options())
    assert flown == [short, other]
    copied = paths_of(tmp_path, long).run
    assert (copied / "frame.png").read_text() == short.identity_hash
    assert not (copied / "models").exists()  # those are of the other training


def test_a_table_holds_the_times_that_were_asked_for(tmp_path, monkeypatch):
    """Another table may have asked for more of the same cell."""
    conditions = Conditions(budget="seconds:60", snapshots=("seconds:60",))
    cell = Cell("flat", "a", "r3-ahead", 0, conditions, "b", 9)
    found = [
        record("", 0, [1.0], 1, snapshot=snapshot, sensing={}, training={})
        for snapshot in ("seconds:30", "seconds:60")
    ]
    written = []
    monkeypatch.setattr(captures, "cells_of", lambda options, row, root: [cell])
    monkeypatch.setattr(captures, "run_in_turn", lambda cells, root, options: None)
    monkeypatch.setattr(captures, "read_records", lambda root, cells: found)
    monkeypatch.setattr(captures, "origin", lambda name, records: None)
    monkeypatch.setattr(
        captures, "write_page", lambda folder, name, rows, records, *_: written.extend(records)
    )
    captures.main(Options(table="gaze", rows=("ahead",), work=tmp_path, out=tmp_path))
    assert [line["snapshot"] for line in written] == ["seconds:60"]
    assert written[0]["policy"] == "ahead"


def test_a_table_counts_views_where_they_are_the_budget(tmp_path, monkeypatch):
    """The cells that are run stop after so many views, and page and files say so."""
    asked, pages = [], []
    monkeypatch.setattr(captures, "run_in_turn", lambda cells, root, options: asked.extend(cells))
    monkeypatch.setattr(
        captures,
        "read_records",
        lambda root, cells: [
            record("", 0, [10.0, 20.0], 95, snapshot="views:30", sensing={}, training={})
        ],
    )
    monkeypatch.setattr(captures, "check_equal_terms", lambda records: None)
    monkeypatch.setattr(
        captures, "origin", lambda name, records: Origin("a command", "none", "abc")
    )
    monkeypatch.setattr(captures, "keep_flights", lambda *given: pages.append(given))
    options = Options(
        table="gaze", rows=("ahead",), size="small", scenes=("flat",), seeds=(3,),
        budget="views", snapshots=(30,), work=tmp_path / "work", out=tmp_path / "out",
    )  # fmt: skip
    folder = captures.main(options)
    (cell,) = asked
    assert (cell.conditions.budget, cell.conditions.clock) == ("views:30", "model")
    assert cell.conditions.loop["capture_every"] == 0.3
    assert {path.name for path in folder.iterdir()} == {
        "gaze_by_views.md", "gaze_by_views_records.jsonl", "gaze_by_views_views_30.csv",
    }  # fmt: skip
    assert "**After 30 views**" in (folder / "gaze_by_views.md").read_text()
    assert not pages  # the model's clock flies the same on every machine


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
    assert [(r["seed"], r["snapshot"]) for r in read_lines(folder / name)] == [
        (seed, f"seconds:{seconds}") for seed in (0, 1) for seconds in (30, 60)
    ]
    # A table may take over what it holds itself.
    before = (folder / name).read_text()
    assert captures.main(replace(here, work=tmp_path / "c", kept=(folder / name,))) == folder
    assert (folder / name).read_text() == before
    assert (folder / flight).read_text() == "as it was flown there"


def test_costs_are_medians_over_all_flights_of_a_row(tmp_path, monkeypatch):
    """A decision counts what the flight hid of it; most frames come without one."""

    def step(planning, hidden, mapping, gaze=None):
        charged = {"planning": planning or 0.0, "mapping": mapping, "flight": 9.0}
        looked = {} if gaze is None else {"gaze": gaze}
        choice = None if planning is None else "a decision"
        return SimpleNamespace(choice=choice, hidden=hidden, charged=charged | looked)

    def flown(policy, seed, rows):
        cell = Cell("flat", "a", policy, seed, Conditions(), "b", 9)
        run = paths_of(tmp_path, cell).run
        if rows:
            run.mkdir(parents=True)
            runs[run] = SimpleNamespace(rows=rows)
        return cell

    runs = {}
    monkeypatch.setattr(captures, "read_run", runs.get)
    cells = {
        "seeing": [
            flown("r3", 0, [step(None, 0, 0.10), step(0.3, 0, 0.20), step(None, 0, 0.30, 0.01)]),
            flown("r3", 1, [step(None, 0, 0.40), step(0.1, 0.8, 0.5, 0.03), step(0.2, 0.1, 0.66)]),
            flown("r3", 2, []),  # flown on another machine
        ],
        "at once": [flown("random", 0, [step(None, 0, 0.05)])],
    }
    assert captures.cost_rows(tmp_path, cells) == [
        {
            "row": "seeing", "a decision": "0.300", "a frame into the map": "0.350",
            "a look on the way": "0.020",
        },
        {
            "row": "at once", "a decision": "", "a frame into the map": "0.050",
            "a look on the way": "",
        },
    ]  # fmt: skip


def test_a_row_is_drawn_in_the_color_of_its_policy(monkeypatch):
    drawn, figure = [], Figure()
    figure.add_subplot()
    monkeypatch.setattr(
        captures, "curve_figure", lambda records, x, y: drawn.extend(records) or figure
    )
    captures.frames_figure([record("active-gs", 0, [1.0], 3), record("seeing, often", 0, [1.0], 3)])
    assert [r["policy"] for r in drawn] == ["active-gs", "seeing (often)"]
    assert figure.axes[0].get_xlabel() == "frames"


def test_two_points_are_no_curve(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(captures, "check_equal_terms", lambda records: None)
    monkeypatch.setattr(
        captures, "frames_figure", lambda records: drawn.append(len(records)) or Figure()
    )
    for snapshots in (("seconds:60",), ("seconds:30", "seconds:60")):
        records = [
            record(label, 0, [10.0, 20.0], 40, snapshot=snapshot)
            for label in ROWS
            for snapshot in snapshots
        ]
        captures.write_page(tmp_path, "gaze", ROWS, records, Origin("a command", "none", "abc"))
        page = (tmp_path / "gaze.md").read_text()
        assert ("gaze_by_frames.png" in page) == (len(snapshots) == 2)
    assert drawn == [4]
