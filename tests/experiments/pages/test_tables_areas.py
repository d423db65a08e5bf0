"""Areas under curves of the benchmark: by hand, on the range that all curves share."""

import numpy as np
import pytest

from experiments.pages.comparison_tables import area_table
from tests.evaluation.records import benchmark, record


def curve(policy, heights, seed=0, scene="flat", snapshots=(10, 20, 60)):
    """Records of two views whose mean PSNR is given for each snapshot."""
    return [
        record(policy, scene, seed, n, psnr=[height - 1.0, height + 1.0])
        for n, height in zip(snapshots, heights, strict=True)
    ]


def fields(table):
    return {
        (row.labels[0], column): entry
        for row in table.rows
        for column, entry in zip(table.columns, row.entries, strict=True)
    }


def test_areas_by_hand():
    cells = [
        *curve("random", [20.0, 20.0, 20.0]),
        *curve("r3", [18.0, 22.0, 30.0]),
        *curve("r3", [22.0, 22.0, 22.0], seed=1),
    ]
    table = area_table(cells)
    found = fields(table)
    assert found["random", "flat"].value == pytest.approx(20.0)
    first = (10 * 20.0 + 40 * 26.0) / 50
    assert found["r3", "flat"].value == pytest.approx((first + 22.0) / 2)
    assert found["r3", "mean"].value == pytest.approx((first + 22.0) / 2)
    assert [found[m, "flat"].rank for m in ("random", "r3")] == [2, 1]
    assert table.notes[-1] == "Range of views: flat 10 to 60."
    assert table.title == "PSNR [dB]: area under the curve over views"
    assert "views:10, views:20, views:60 on the" in table.notes[0]
    assert table.notes[1].startswith("1 to 2 seeds per cell")


def test_all_methods_have_one_range():
    """Random took twice the seconds, so only its first and ours' last part count."""
    cells = [*curve("random", [20.0, 24.0, 40.0]), *curve("r3", [20.0, 24.0, 40.0])]
    for cell in cells:
        pace = 2.0 if cell["policy"] == "random" else 1.0
        cell["exploration"]["seconds"] = pace * cell["exploration"]["views"]
    found = fields(area_table(cells, x="seconds"))
    assert found["r3", "flat"].value == pytest.approx(np.mean([24.0, 40.0]))  # from 20 to 60
    at_60 = 24.0 + 16.0 * 10 / 40
    random = (20 * 22.0 + 20 * (24.0 + at_60) / 2) / 40
    assert found["random", "flat"].value == pytest.approx(random)


def test_a_run_that_ended_early_and_one_without_a_curve():
    cells = [*curve("random", [20.0, 21.0, 21.0]), *curve("r3", [20.0, 22.0, 24.0])]
    cells[2]["exploration"]["views"] = 20  # trapped: views:60 shows the model of views:20
    cells += curve("frontier", [25.0], snapshots=(10,))
    cells += [*curve("r3", [20.0, 20.0, 20.0], scene="house")]
    table = area_table(cells)
    found = fields(table)
    assert found["random", "flat"].value == pytest.approx(20.5)
    assert found["r3", "flat"].value == pytest.approx(21.0)
    assert found["r3", "house"].value == pytest.approx(20.0)
    for missing in (("frontier", "flat"), ("random", "house"), ("random", "mean")):
        assert found[missing].value is None
    assert found["r3", "mean"].value == pytest.approx(20.5)
    assert table.notes[-1] == "Range of views: flat 10 to 20, house 10 to 60."


def test_a_scene_without_any_curve_is_missing():
    cells = [*curve("r3", [20.0, 22.0, 24.0]), record("r3", "house")]
    found = fields(area_table(cells))
    assert found["r3", "house"].value is found["r3", "mean"].value is None


def test_lower_lpips_is_better():
    table = area_table(benchmark(("random", "r3"), snapshots=(20, 60)), metric="lpips")
    found = fields(table)
    assert found["r3", "mean"].value < found["random", "mean"].value
    assert found["r3", "mean"].rank == 1


def test_mistakes_are_named():
    cells = benchmark(("random", "r3"), ("flat",), (0,), (20, 60))
    with pytest.raises(ValueError, match="no budget 'days'; there are views, seconds"):
        area_table(cells, x="days")
    with pytest.raises(ValueError, match="no metric 'mse'"):
        area_table(cells, metric="mse")
    with pytest.raises(ValueError, match="one kind, got seconds and views"):
        area_table([*cells, record(seed=9) | {"snapshot": "seconds:5"}])
    for cell in cells[2:]:
        cell["exploration"]["views"] += 100
    with pytest.raises(ValueError, match="flat: the curves share no range"):
        area_table(cells)
