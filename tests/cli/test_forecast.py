"""`r3jax forecast RUN` and `r3jax explore --until`, as a user meets them."""

import json

import pytest

from r3jax.apps.forecast.psnr import default_calibration, write_calibration
from r3jax.cli.main import main
from r3jax.runs.reader import read_run
from tests.cli.small_runs import explore, main_without_report


@pytest.fixture(scope="module")
def runs(room, tmp_path_factory):
    """`box` ended by its forecast after five of nine views: any forecast is more than -99 dB."""
    out = tmp_path_factory.mktemp("runs")
    assert explore(room, out, "--budget", "views:9", "--until", "psnr:-99@p10", report=True) == 0
    return out


@pytest.mark.full
def test_a_run_that_is_good_enough_says_so(runs):
    run = read_run(runs / "box")
    assert len(run.rows) == 5
    assert run.end.outcome == "forecast"
    assert "p10" in run.end.message
    assert run.header.config["until"] == "psnr:-99@p10"
    page = (runs / "box" / "report" / "report.html").read_text()
    assert "Is it enough?" in page
    assert "p10" in page


@pytest.mark.full
def test_going_on_takes_another_goal(runs, capsys):
    words = ["explore", "--resume", str(runs / "box"), "--until", "psnr:99", "--budget", "views:6"]
    assert main_without_report(words) == 0
    assert "stopped   6 views" in capsys.readouterr().err
    run = read_run(runs / "box")
    assert len(run.rows) == 6
    assert run.header.config["until"] == "psnr:99"


@pytest.mark.full
def test_a_forecast_is_told_view_by_view(runs, tmp_path, capsys):
    plot = tmp_path / "forecast.png"
    assert main(["forecast", str(runs / "box"), "--plot", str(plot)]) == 0
    lines = capsys.readouterr().out.splitlines()
    start = lines.index("views   mean   p10   p50")
    told = [line.split() for line in lines[start + 1 : start + 7]]
    assert [words[0] for words in told] == ["1", "2", "3", "4", "5", "6"]
    assert f"{told[-1][1]} dB" in lines[start + 7]
    assert plot.read_bytes().startswith(b"\x89PNG")


@pytest.mark.full
def test_a_calibration_of_ones_own(runs, tmp_path, capsys):
    path = tmp_path / "mine.json"
    write_calibration(path, default_calibration())
    fields = json.loads(path.read_text())
    fields["location"][0] += 10.0
    path.write_text(json.dumps(fields | {"source": "my own models"}))
    told = []
    for words in ([], ["--calibration", str(path)]):
        assert main(["forecast", str(runs / "box"), *words]) == 0
        out = capsys.readouterr().out
        told.append(float(out.split("mean of all views (mean): ")[1].split()[0]))
    assert "calibrated on my own models" in out.replace("\n", " ")
    assert told[1] == pytest.approx(told[0] + 10.0, abs=0.11)


@pytest.mark.full
def test_a_file_that_is_no_calibration_is_told(runs, tmp_path, capsys):
    path = tmp_path / "mine.json"
    path.write_text("[]")
    assert main(["forecast", str(runs / "box"), "--calibration", str(path)]) == 2
    assert "mine.json" in capsys.readouterr().err
