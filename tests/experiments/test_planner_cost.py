"""What planning costs: a short mission measured for real, and the tables by hand."""

import json

import numpy as np
import pytest
from PIL import Image

from experiments import planner_latency, planner_memory, planner_runs
from experiments.planner_runs import Options, Size

pytestmark = pytest.mark.full

VIEWS = 4


def record(policy, seed, decide, process=(100, 200), commit="abc"):
    """A mission by hand: the decisions' milliseconds, all other parts 1 ms; bytes by key frame."""
    parts = {f"{name}_ms": 1.0 for name in planner_latency._COLUMNS}
    rows = [
        {"key_frames": k, "map_bytes": 1000 * k, "map_used_bytes": 10 * k, "grid_bytes": 200}
        | {"policy_bytes": 30 + seed, "device_bytes": None, "device_peak_bytes": None}
        | {"process_bytes": process[1] + k}
        | parts
        | {"decide_ms": float(ms)}
        for k, ms in enumerate(decide, 1)
    ]
    flight = {"policy": policy, "scene": "flat", "seed": seed, "commit": commit}
    return {
        "flight": flight,
        "machine": "m",
        "process_bytes_before": process[0],
        "rows": rows,
        "compiled_bytes": 7_000_000,
    }


@pytest.fixture
def records():
    return [record("a", 0, [1, 2, 3, 4]), record("a", 1, [5, 6, 7, 8]), record("b", 0, [9, 9, 9])]


def test_percentiles_by_group(records):
    rows = planner_latency.percentile_rows(records, 2)
    found = [row for row in rows if row["policy"] == "a" and row["part"] == "decide"]
    assert [(row["first"], row["last"], row["steps"]) for row in found] == [(1, 2, 4), (3, 4, 4)]
    assert [row["p50_ms"] for row in found] == [3.5, 5.5]  # of 1 2 5 6, and of 3 4 7 8
    np.testing.assert_allclose(found[0]["p99_ms"], 6 - 0.03)
    assert {row["p95_ms"] for row in rows if row["part"] == "observe"} == {1.0}


def test_the_figure_gets_full_groups_only(records):
    samples = planner_latency.decide_samples(records, 2)
    frames, values = samples["a"]
    np.testing.assert_array_equal(frames, [1.5, 3.5])
    np.testing.assert_array_equal(np.sort(values), [[1, 2, 5, 6], [3, 4, 7, 8]])
    np.testing.assert_array_equal(samples["b"][0], [1.5])


def test_memory_is_the_largest_over_missions(records):
    curves = planner_memory.held_curves(records)
    np.testing.assert_array_equal(curves["a"][0], [1, 2, 3, 4])
    np.testing.assert_array_equal(curves["a"][1], [1231, 2231, 3231, 4231])
    kind, growth = planner_memory.total_curves(records)
    assert kind == "process"
    np.testing.assert_array_equal(growth["b"][1], [101, 102, 103])
    for found in records:
        for row in found["rows"]:
            row["device_peak_bytes"] = 7
    kind, device = planner_memory.total_curves(records)
    assert kind == "device"
    assert set(device["b"][1]) == {7}


@pytest.fixture
def tiny(monkeypatch, tmp_path):
    """A size of a few views of one room, flown in this process."""
    monkeypatch.setitem(planner_runs.SIZES, "smoke", Size(("flat",), (0,), VIEWS, 32, 2))
    flown = []

    class SameProcess:
        def __init__(self, *args, **kwargs):
            pass

        __enter__ = lambda self: self
        __exit__ = lambda self, *args: None

        def submit(self, function, flight):
            flown.append(flight)
            self.result = lambda: function(flight)
            return self

    monkeypatch.setattr(planner_runs, "ProcessPoolExecutor", SameProcess)
    options = Options("smoke", ("random",), tmp_path / "results", tmp_path / "work")
    return options, flown


def test_a_mission_is_measured_once_and_shown_twice(tiny):
    options, flown = tiny
    latency, memory = planner_latency.main(options), planner_memory.main(options)
    assert len(flown) == 1
    found = json.loads((options.work / "random-flat-32px-seed0.json").read_text())
    assert [row["key_frames"] for row in found["rows"]] == list(range(1, VIEWS))
    # Some megabytes of programs for one room; unknown on other systems than Linux.
    assert found["compiled_bytes"] is None or 1e6 < found["compiled_bytes"] < 1e9
    for row in found["rows"]:
        assert row["decide_ms"] > row["decide.travel_ms"] > 0.0
        assert row["observe_ms"] > 0.0
        assert row["map_bytes"] > row["map_used_bytes"] > 0
        cells = (row["grid_bytes"] - 16) // 4  # beside the origin and the cells' size
        assert row["policy_bytes"] >= 2 * cells + 16  # trail, attempted; the camera
    assert {path.name for path in latency.iterdir()} == {
        "steps.csv", "percentiles.csv", "latency.png", "latency.md",
    }  # fmt: skip
    names = {path.name for path in memory.iterdir()}
    assert {"steps.csv", "arrays.png", "memory.md"} <= names
    for path in (latency / "latency.png", memory / "arrays.png"):
        with Image.open(path) as picture:
            described = picture.info["Description"]
        assert "command: python -m experiments.planner_" in described
        assert "machine: " in described
        assert "commit: " in described
