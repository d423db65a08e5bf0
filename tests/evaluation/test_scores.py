"""Rows and summaries: what the tails are, which way is bad, files that lose nothing."""

import csv
import math
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.evaluation.scores import ViewRow, bootstrap_interval, summarize, worst_rows, write_rows


def row(view, psnr=25.0, **changes):
    fields = {"ssim": 0.8, "lpips": 0.2, "psnr_measured": 26.0, "measured": 0.9}
    fields |= {"coverage": 0.99, "renderability": 0.5}
    return ViewRow(view=view, psnr=psnr, **fields | changes)


def summary_of(rows, name):
    summaries = summarize(rows)
    return {summary.metric.name: summary for summary in summaries}.get(name)


def test_tails() -> None:
    """101 views with values 0 ... 100 in mixed order: the percentiles are known."""
    values = np.random.default_rng(0).permutation(101)
    rows = [row(7 + i, float(v), lpips=float(v)) for i, v in enumerate(values)]
    place = {int(v): 7 + i for i, v in enumerate(values)}
    psnr = summary_of(rows, "psnr")
    assert (psnr.views, psnr.mean, psnr.median) == (101, 50.0, 50.0)
    assert (psnr.percentile_5, psnr.worst, psnr.worst_view) == (5.0, 0.0, place[0])
    assert psnr.poor_share == 20 / 101  # 20 dB itself is not poor
    lpips = summary_of(rows, "lpips")
    assert (lpips.percentile_5, lpips.worst, lpips.worst_view) == (95.0, 100.0, place[100])
    assert lpips.poor_share is None


def test_gaps() -> None:
    """Views without a value do not count, and are not 0."""
    rows = [row(0, psnr_measured=math.nan), row(1, psnr_measured=30.0), row(2, lpips=None)]
    measured = summary_of(rows, "psnr_measured")
    assert (measured.views, measured.mean) == (2, 28.0)
    assert summary_of(rows, "lpips").views == 2
    assert summary_of([row(0, lpips=None)], "lpips") is None
    assert summary_of(rows, "psnr").views == 3


def test_interval() -> None:
    """As wide as the central limit theorem says, and round the mean; repeatable."""
    values = np.random.default_rng(1).normal(25.0, 3.0, 400)
    low, high = bootstrap_interval(values, seed=5)
    expected = 1.96 * values.std() / 20.0
    assert 0.9 * expected < values.mean() - low < 1.1 * expected
    assert 0.9 * expected < high - values.mean() < 1.1 * expected
    assert bootstrap_interval(values, seed=5) == (low, high)
    assert bootstrap_interval(values, seed=6) != (low, high)


@given(st.lists(st.floats(0.0, 60.0), min_size=1, max_size=12))
def test_the_interval_holds_the_mean_of_resamples(values):
    low, high = bootstrap_interval(np.array(values))
    assert min(values) - 1e-9 <= low <= high <= max(values) + 1e-9
    if len(set(values)) == 1:
        assert (low, high) == pytest.approx((values[0], values[0]))


def test_the_seed_reaches_the_summary():
    rows = [row(i, float(20 + i)) for i in range(9)]
    assert summarize(rows, seed=1) == summarize(rows, seed=1)
    assert summarize(rows, seed=1) != summarize(rows, seed=2)


def test_the_worst_have_the_lowest_psnr_worst_first():
    rows = [row(0, 30.0), row(1, 12.0), row(2, 20.0), row(3, 25.0)]
    assert [r.view for r in worst_rows(rows, 3)] == [1, 2, 3]
    assert len(worst_rows(rows, 9)) == 4


def test_csv_keeps_every_digit(tmp_path):
    rows = [row(3, 1 / 3), row(11, 22.1, lpips=None, renderability=None, psnr_measured=math.nan)]
    write_rows(tmp_path / "rows.csv", rows)
    with open(tmp_path / "rows.csv", newline="") as file:
        first, second = csv.DictReader(file)
    assert list(first) == [
        *("view", "psnr", "ssim", "lpips", "psnr_measured"),
        *("measured", "coverage", "renderability"),
    ]
    assert (int(first["view"]), float(first["psnr"])) == (3, 1 / 3)
    assert (second["lpips"], second["renderability"]) == ("", "")
    assert math.isnan(float(second["psnr_measured"]))


def test_parquet_keeps_every_digit(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    write_rows(tmp_path / "rows.parquet", [row(3, 1 / 3), row(4, lpips=None)])
    table = parquet.read_table(tmp_path / "rows.parquet").to_pydict()
    assert (table["view"], table["psnr"]) == ([3, 4], [1 / 3, 25.0])
    assert table["lpips"] == [0.2, None]


def test_mistakes_are_named(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="no view"):
        summarize([])
    with pytest.raises(ValueError, match=r"\.parquet.*\.xlsx"):
        write_rows(tmp_path / "rows.xlsx", [row(0)])
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ImportError, match="pyarrow"):
        write_rows(tmp_path / "rows.parquet", [row(0)])
    assert not list(tmp_path.iterdir())
