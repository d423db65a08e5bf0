"""What lies beside a model: damaged train.json, evaluation.json and history.csv.

All 2,000 cases: `pytest -m slow tests/fuzz/test_models.py`.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from r3jax.apps.report.model_report import (
    quality_note,
    quality_table,
    read_evaluated_model,
    training_figure,
)
from r3jax.evaluation.judge import choose_views, mapped_views
from r3jax.formats.captures import open_capture
from r3jax.formats.errors import FormatError
from r3jax.runs.header import RunError
from r3jax.splatting.errors import SceneFileError
from r3jax.splatting.model import find_model
from tests.fuzz import test_runs
from tests.fuzz.harness import CASES_SLOW
from tests.fuzz.mutate import mutate
from tests.fuzz.tree import Files
from tests.fuzz.worker import Reader

pytestmark = pytest.mark.full

CASES = 150
"""In the normal suite."""

METRIC = {
    "views": 1, "mean": 21.5, "interval": [20.0, 23.0], "median": 21.0, "percentile_5": 18.0,
    "worst": 17.5, "worst_view": 2, "poor_share": 0.25,
}  # fmt: skip


def seeds() -> list[Files]:
    run = {k: v for k, v in test_runs.seeds()[0].items() if not k.startswith("frames")}
    train = {
        "data": "case", "resolution": 8, "train_views": [0, 1], "test_views": [2],
        "config": {"background": "white"}, "packages": {"r3jax": "0"},
    }  # fmt: skip
    evaluation = {
        "model": "case/models/last/scene.ply", "gaussians": 5, "data": "case", "numbers": [2],
        "trained_on": 0, "width": 8, "height": 6, "bootstrap_seed": 0,
        "metrics": {"psnr": METRIC, "ssim": METRIC | {"poor_share": None}},
    }  # fmt: skip
    rows = "".join(f"{i},0.{i},{20 + i}.5,{100 * i}\n" for i in range(1, 6))
    return [
        run
        | {
            "models/last/scene.ply": b"ply\n",
            "models/last/train.json": json.dumps(train, indent=1).encode(),
            "models/last/history.csv": f"step,loss,psnr,gaussians\n{rows}".encode(),
            "report/evaluation.json": json.dumps(evaluation, indent=1).encode(),
            "report/evaluation.png": b"\x89PNG",
        }
    ]


def make(rng: np.random.Generator, files: Files) -> tuple[Files, str]:
    """The run itself stays whole."""
    parts = ("models/last/train.json", "models/last/history.csv", "report/")
    changed, what = mutate(rng, {k: v for k, v in files.items() if k.startswith(parts)})
    return {k: v for k, v in files.items() if not k.startswith(parts)} | changed, what


def read(folder: Path) -> None:
    capture = open_capture(folder)
    trained = find_model(capture.models, capture.path)
    test = choose_views("heldout", capture, trained)
    assert all(0 <= number < len(capture) for number in test.numbers)
    assert all(0 <= n < len(capture) for n in mapped_views(trained, test, capture))
    assert np.isfinite(trained.background).all()
    assert capture.run is not None
    model = read_evaluated_model(capture.run)
    if model is not None:
        # What is accepted can be shown: nothing breaks later.
        assert "nan" not in quality_table(model.evaluation)
        assert quality_note(model.evaluation)
        if model.history:
            training_figure(model.history)


READER = Reader(seeds, read, (FormatError, SceneFileError, RunError), make=make)


def test_damaged_models_are_refused_or_read(harness):
    harness.check(__name__, CASES)


@pytest.mark.slow
def test_many_damaged_models(harness):
    """`pytest -m slow tests/fuzz/test_models.py`."""
    harness.check(__name__, CASES_SLOW)
