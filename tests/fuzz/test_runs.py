"""Run folders with damaged settings, rows, timings and images.

All 2,000 cases: `pytest -m slow tests/fuzz/test_runs.py`.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from r3jax.exploration.taken_views import to_integers
from r3jax.geometry.cameras import rigid_error
from r3jax.runs.header import RunError, header_to_json
from r3jax.runs.reader import read_run
from r3jax.runs.rows import EndRow, to_json
from r3jax.runs.writer import encode_png
from tests.fuzz.harness import CASES_SLOW
from tests.fuzz.tree import Files, unsealed
from tests.fuzz.worker import Reader
from tests.runs.runs import make_header, make_view

pytestmark = pytest.mark.full

CASES = 150
"""In the normal suite."""


def seeds() -> list[Files]:
    files = {"run.json": header_to_json(make_header()).encode()}
    lines = []
    for step in range(3):
        row, frame = make_view(step)
        rgb, depth = to_integers(frame)
        files[f"frames/{step:06d}.png"] = encode_png(rgb)
        files[f"frames/{step:06d}.depth.png"] = encode_png(depth)
        lines.append(to_json(row))
    lines.append(to_json(EndRow("budget", "all views taken", 3)))
    files["trace.jsonl"] = "".join(line + "\n" for line in lines).encode()
    timing = json.dumps({"step": 0, "render": 0.1, "plan": 0.25}) + "\n"
    files["timings.jsonl"] = 3 * timing.encode()
    files = unsealed(files)
    rows_only = {name: files[name] for name in ("run.json", "trace.jsonl", "timings.jsonl")}
    return [files, rows_only]


def read(folder: Path) -> None:
    run = read_run(folder)
    camera = run.camera
    assert all(np.isfinite(x) for x in (camera.fx, camera.fy, camera.cx, camera.cy))
    assert np.asarray(run.header.bounds).shape == (2, 3)
    for row in run.rows:
        assert rigid_error(row.pose) is None
        assert np.isfinite([row.seconds, row.metres, row.radians, *row.charged.values()]).all()
        assert np.isfinite([float(x) for x in vars(row.coverage).values()]).all()
        if row.choice is not None:
            assert np.isfinite(row.choice.waypoints).all()
            assert row.choice.waypoints.shape[1:] == (3,)
    for timing in run.timings:
        assert np.isfinite(list(timing.values())).all()
    assert run.outcome
    if not (folder / "frames").exists():
        return
    for frame in run.frames():
        assert np.isfinite(frame.rgb).all()
        assert not np.isnan(frame.depth).any()


READER = Reader(seeds, read, (RunError,))


def test_damaged_runs_are_refused_or_read(harness):
    harness.check(__name__, CASES)


@pytest.mark.slow
def test_many_damaged_runs(harness):
    """`pytest -m slow tests/fuzz/test_runs.py`."""
    harness.check(__name__, CASES_SLOW)
