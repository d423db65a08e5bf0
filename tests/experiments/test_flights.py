"""The poses beside a table: of every flight, called as its row, copied where flown elsewhere."""

from pathlib import Path

import pytest

from experiments import flights
from r3jax.apps.benchmark.cells import Cell, Conditions, paths_of
from r3jax.formats.submissions import read_submission
from tests.formats.test_submissions import make_submission


@pytest.fixture
def flown(tmp_path, monkeypatch):
    """A function that leaves what a run of the cell would leave."""
    runs = {}

    def fly(cell):
        run = paths_of(tmp_path, cell).run
        run.mkdir(parents=True)
        runs[run] = make_submission(seed=cell.seed, policy={"name": "?", "version": cell.policy})
        return cell

    monkeypatch.setattr(flights, "read_run", lambda path: path)
    monkeypatch.setattr(flights, "submission_of_run", runs.get)
    return fly


def a_cell(policy, seed, scene="flat"):
    return Cell(scene, "a", policy, seed, Conditions(), "b", 9)


def test_every_flight_is_written_once_under_the_name_of_its_row(tmp_path, flown):
    cells = {
        f"{policy}, every 0.15 m": [
            flown(a_cell(policy, seed, scene))
            for scene in ("flat", "mesh:../scenes/hall.glb")
            for seed in (0, 3)
        ]
        for policy in ("r3", "random")
    }
    flights.keep_flights(tmp_path, "some", tmp_path, cells)
    written = {path.name: read_submission(path) for path in (tmp_path / "some_flights").iterdir()}
    assert {name: (file.policy, file.seed) for name, file in written.items()} == {
        f"{policy}-every-0.15-m_{scene}_{seed}.jsonl": (
            {"name": f"{policy}, every 0.15 m", "version": policy},
            seed,
        )
        for policy in ("r3", "random")
        for scene in ("flat", "hall")
        for seed in (0, 3)
    }


def test_the_flights_that_stand_in_the_results_are_read_by_this_version():
    files = sorted((Path(flights.__file__).parent / "results").rglob("*_flights/*.jsonl"))
    assert files
    for path in files:
        assert path.stem.endswith(f"_{read_submission(path).seed}"), path
