"""The report: it tells the run's own numbers, whole in one file, and its pictures are right."""

import base64
import dataclasses
import json
import re
import shutil

import numpy as np
import pytest
from matplotlib.collections import LineCollection

from r3jax.apps.forecast.forecast import forecast_map
from r3jax.apps.report.figures import (
    plan_figure,
    progress_figure,
    reasons_figure,
    shares_of,
    utility_by_cause,
)
from r3jax.apps.report.report import write_report
from r3jax.apps.report.summary import map_row_bytes, stage_times, summary
from r3jax.exploration import explore
from r3jax.exploration.config import ExplorationConfig
from r3jax.plots import style
from r3jax.runs.header import RunError, camera_fields
from r3jax.runs.reader import read_run
from r3jax.runs.replay import explain_run
from r3jax.runs.writer import RunWriter
from r3jax.scoring.explain import CAUSES
from tests.exploration.toys import BoxRoom, Wander
from tests.runs.runs import make_flight, make_header, make_view

CONFIG = ExplorationConfig(voxel_size=0.1, capacity=1 << 13, clock="model", num_probes=4)


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    """A short run in the box room and its page."""
    path = tmp_path_factory.mktemp("report") / "run"
    room = BoxRoom()
    scene = {"name": "<box> & room", "hash": "0123abcd"}
    config = dataclasses.asdict(CONFIG)
    policy = {"name": "wander", "settings": {"num_candidates": 7, "num_frontier": 2}}
    fields = {"scene": scene, "config": config, "policy": policy}
    header = make_header(camera=camera_fields(room.camera), **fields)
    with RunWriter(path, header) as recorder:
        result = explore(room, Wander(), budget="views:4", config=CONFIG, recorder=recorder)
    run = read_run(path)
    stages: list[list] = []

    def on_progress(stage, steps):
        if stage:
            stages.append([stage, steps, 0])
        else:
            stages[-1][2] += steps

    page = write_report(run, result.state.planner, on_progress)
    assert stages == [["explaining the views", 3, 3], ["drawing the report", 7, 7]]
    return run, result, page


def test_the_page_stands_alone(reported):
    run, _, page = reported
    text = page.read_text()
    assert page == run.path / "report" / "report.html"
    assert not re.search(r"(src|href)=\"(?!data:)", text)
    images = re.findall(r"data:image/png;base64,([A-Za-z0-9+/=]+)", text)
    files = {path.read_bytes() for path in page.parent.glob("*.png")}
    assert {base64.b64decode(image) for image in images} == files
    assert len(files) == 7


def test_progress_counts_frames_where_there_are_some_on_the_way(reported):
    run, _, _ = reported
    rows = (*run.rows[:-1], dataclasses.replace(run.rows[-1], captured=True))
    for told, unit in ((run, "views"), (dataclasses.replace(run, rows=rows), "frames")):
        above, _, below, _ = progress_figure(told).axes
        assert above.get_title(loc="left") == f"Against {unit}"
        assert below.get_xlabel() == unit


def test_the_path_from_above_is_as_long_as_flown(reported):
    """The first of two merged runs ends on the way, and a frame lies behind each corner."""
    run, result, _ = reported
    corner = np.array([[1.0, 1.0, 1.3], [1.3, 1.0, 1.3], [1.3, 1.5, 1.3]])
    first = make_flight([(corner, 2), (corner, 4)])[:-1]
    rows = [*first, *make_flight([(corner[::-1], 2)], first[-1])]
    merged = dataclasses.replace(run, rows=tuple(rows))
    axes = plan_figure(merged, result.state.map_state, result.state.grid).axes[0]
    drawn = [lines for lines in axes.collections if isinstance(lines, LineCollection)]
    assert len(drawn) == 2  # the path and its white edge
    for lines in drawn:
        steps = np.concatenate([np.diff(line, axis=0) for line in lines.get_segments()])
        assert np.linalg.norm(steps, axis=1).sum() == pytest.approx(rows[-1].metres, rel=1e-5)


def test_the_page_tells_the_runs_own_numbers(reported):
    run, _, page = reported
    text = page.read_text()
    last = run.rows[-1]
    assert f"<b>{last.metres:.1f} m</b>" in text
    assert f"<b>{last.coverage.mean_renderability:.2f}</b>" in text
    assert "budget of 4 views" in text
    assert "0123abcd" in text
    assert "num candidates 7" in text
    assert "&lt;box&gt; &amp; room" in text  # a name from outside is text, never markup
    assert "<box>" not in text


def test_the_page_forecasts_what_a_model_would_be_worth(reported):
    """The last of the curve's points is a forecast of the map that the run ended with."""
    run, result, page = reported
    forecast = forecast_map(result.state.map_state, result.state.grid, run.camera)
    low, high = forecast.interval("p10")
    said = f"(p10): {forecast.value('p10'):.1f} dB ({low:.1f} to {high:.1f})"
    assert said in page.read_text()


def test_views_are_explained_as_they_were_chosen(reported):
    """Wander decides by chance: what counts is what the views that it chose promised."""
    run, _, page = reported
    utility = utility_by_cause(run)
    assert utility.shape == (4, 4)
    assert np.isnan(utility[0]).all()  # nobody chose the start
    for found, reason in zip(utility[1:], list(explain_run(run))[1:], strict=True):
        np.testing.assert_array_equal(found, reason.totals)
    assert (utility[1:, 0] > 0.0).all()
    assert (utility[1:].sum(axis=1) > utility[1:, 0]).any()
    assert (page.parent / "reasons.png").exists()


def test_the_bars_of_a_view_are_its_shares():
    nan = float("nan")
    utility = np.array([[nan] * 4, [48.0, 24.0, 8.0, 0.0], [0.0] * 4, [0.0, 1.0, 1.0, 2.0]])
    expected = np.array([[60.0, 30.0, 10.0, 0.0], [0.0] * 4, [0.0, 25.0, 25.0, 50.0]])
    np.testing.assert_allclose(shares_of(utility)[1:], expected / 100.0)
    assert np.isnan(shares_of(utility)[0]).all()
    upper, lower = reasons_figure(utility).axes
    for number, bars in enumerate(upper.containers):
        assert bars.get_label() == CAUSES[number]
        assert [bar.get_height() for bar in bars] == pytest.approx(expected[:, number])
        below = expected[:, :number].sum(axis=1)
        assert [bar.get_y() for bar in bars] == pytest.approx(below)
    # A logarithm shows no 0.
    amounts = [[48.0, nan, nan], [24.0, nan, 1.0], [8.0, nan, 1.0]]
    for line, color, amount in zip(
        lower.lines, style.CAUSE_COLORS, [*amounts, [nan, nan, 2.0]], strict=True
    ):
        assert line.get_color() == color
        np.testing.assert_array_equal(line.get_xdata(), [1, 2, 3])
        np.testing.assert_array_equal(line.get_ydata(), amount)
    style.to_png(reasons_figure(utility[:1]))  # the start alone can be drawn


def test_a_run_that_cannot_be_explained_has_a_report_all_the_same(reported, tmp_path):
    run, result, _ = reported
    shutil.copytree(run.path, tmp_path / "merged")
    header = dataclasses.replace(run.header, parent={"merged": ["a", "b"], "merged_views": [2, 2]})
    shutil.rmtree(tmp_path / "merged" / "report")
    merged = dataclasses.replace(run, path=tmp_path / "merged", header=header)
    page = write_report(merged, result.state.planner)
    assert "Not known" in page.read_text()
    assert not (page.parent / "reasons.png").exists()


def test_a_run_without_views_has_no_report(reported, tmp_path):
    with RunWriter(tmp_path / "run", make_header()):
        pass
    run = read_run(tmp_path / "run")
    with pytest.raises(RunError, match="no view"):
        write_report(run, reported[1].state.planner)
    assert summary(run)["views"] == "0"


def test_a_run_that_was_cut_off_can_be_reported(reported, tmp_path):
    run, result, _ = reported
    rows = (run.path / "trace.jsonl").read_text().splitlines(keepends=True)
    (tmp_path / "cut").mkdir()
    (tmp_path / "cut" / "run.json").write_bytes((run.path / "run.json").read_bytes())
    (tmp_path / "cut" / "trace.jsonl").write_text("".join(rows[:2]))
    (tmp_path / "cut" / "frames").symlink_to(run.path / "frames")
    page = write_report(read_run(tmp_path / "cut"), result.state.planner)
    assert "cut off" in page.read_text()


def test_stage_times_are_percentiles_of_what_was_measured(tmp_path):
    with RunWriter(tmp_path / "run", make_header()) as writer:
        for step in range(20):
            writer.add(*make_view(step))
            writer.add_timings(step, {"plan": float(step), "render": 0.5, "novel": 1.0})
    times = {stage.name: stage for stage in stage_times(read_run(tmp_path / "run"))}
    assert times["planning"].median == 9.5
    assert times["planning"].p95 == pytest.approx(18.05)
    assert times["planning"].total == 190.0
    assert times["planning"].on_clock
    assert not times["simulator"].on_clock
    assert times["– novel"].total == 20.0


def test_timings_that_are_damaged_do_not_hurt(tmp_path):
    with RunWriter(tmp_path / "run", make_header()) as writer:
        writer.add(*make_view(0))
        writer.add_timings(0, {"plan": 2.0})
    timings = tmp_path / "run" / "timings.jsonl"
    timings.write_text(timings.read_text() + "[1]\nnonsense\n" + json.dumps({"step": 1}))
    assert [stage.total for stage in stage_times(read_run(tmp_path / "run"))] == [2.0]


def test_memory_is_counted_as_the_map_counts_it(reported):
    run, result, _ = reported
    assert map_row_bytes(run) == result.state.map_state.bytes_per_row
