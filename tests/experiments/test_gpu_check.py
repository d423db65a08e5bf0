"""The check of a GPU: it refuses to praise a CPU, runs every step, and tells what failed."""

import json
import sys

import pytest

from experiments import gpu_check
from experiments.gpu_check import Options, Step, benchmark_rows, main, run


def test_without_a_gpu_it_says_what_to_install(tmp_path):
    with pytest.raises(SystemExit, match="--any-device"):
        main(Options(out=tmp_path))
    assert not list(tmp_path.iterdir())


def test_a_step_that_fails_is_told_with_its_last_line(tmp_path):
    good = run(Step("good", (sys.executable, "-c", "print('3 passed')")), tmp_path)
    bad = run(
        Step("bad", (sys.executable, "-c", "print('1 failed'); raise SystemExit(4)")), tmp_path
    )
    assert (good["result"], good["last line"]) == ("passed", "3 passed")
    assert (bad["result"], bad["last line"]) == ("failed (4)", "1 failed")
    assert good["seconds"] > 0.0


def test_the_table_holds_every_step_and_every_median(tmp_path, monkeypatch):
    report = {"benchmarks": [{"fullname": "tests/benchmarks/test_x.py::test_y",
                              "stats": {"median": 0.0125, "min": 0.01}}]}  # fmt: skip
    assert benchmark_rows(report)[0]["median [ms]"] == pytest.approx(12.5)

    def steps(options, timings):
        write = f"open({str(timings)!r}, 'w').write({json.dumps(report)!r})"
        return [Step("benchmarks", (sys.executable, "-c", write)),
                Step("tests", (sys.executable, "-c", "raise SystemExit(1)"))]  # fmt: skip

    monkeypatch.setattr(gpu_check, "steps_of", steps)
    assert main(Options(out=tmp_path, any_device=True)) == 1
    page = (tmp_path / "gpu_check.md").read_text()
    assert "test_x.py::test_y | 12.5 | 10" in page
    assert "| tests | failed (1) |" in page
    assert "command: python -m experiments.gpu_check" in page
