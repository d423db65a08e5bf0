"""Areas under curves of the benchmark: by hand, on the range that all curves share."""

import numpy as np
import pytest

from experiments.pages.comparison_tables import area_table
from tests.evaluation.records import record


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
