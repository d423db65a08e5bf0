"""What chosen views were to mend: means over parts, views and seeds, by hand."""

import numpy as np
import pytest

from experiments import causes
from experiments.pages.artifacts import Origin
from tests.box_room import write_room
from tests.cli.small_runs import explore
from tests.evaluation.records import record

pytestmark = pytest.mark.full


def test_means_are_over_the_views_of_a_part_and_the_seeds():
    records = [record("ours-pano", scene, seed) for scene in ("flat", "office") for seed in (0, 1)]
    views = np.arange(6.0)[:, None] * [6.0, 3.0, 1.0, 0.0]
    rows = causes.table_rows(records, [views, views + 2.0, 10.0 * views, 10.0 * views])
    assert [(row["scene"], row["part"]) for row in rows] == [
        (scene, f"{part} of 3") for scene in ("flat", "office") for part in (1, 2, 3)
    ]
    first = rows[0]  # views 0 and 1 of both seeds
    assert [first[cause] for cause in causes.CAUSES] == [4.0, 2.5, 1.5, 1.0]
    assert first["inconsistent, share of U_R [%]"] == pytest.approx(30.0)
    assert rows[5]["never seen"] == 270.0


def test_every_chosen_view_of_a_run_is_explained(tmp_path):
    explore(write_room(tmp_path / "room.ply"), tmp_path)
    totals = causes.totals_of(tmp_path / "box")
    assert totals.shape == (2, 4)  # nobody chose the first of the three
    assert (totals >= 0.0).all()
    assert totals.sum() > 0.0
    rows = causes.table_rows([record("random")], [np.concatenate([totals, totals])])
    causes.write_page(tmp_path, rows, Origin("a command", "a machine", "abc"))
    page = (tmp_path / "causes.md").read_text()
    assert page.count("| random | flat |") == causes.PARTS
    assert "commit: abc" in page
