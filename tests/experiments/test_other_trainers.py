"""Models of one flight by several trainers: which belong together, and their numbers by hand."""

import json

import numpy as np
import pytest

from experiments import other_trainers
from experiments.expected_error import Model
from experiments.other_trainers import Options, flight_of, main, model_row, summary_rows
from r3jax.scoring.expected_error import TERMS

VANILLA = {"strategy": "vanilla", "iterations": 6000, "resolution": 128, "capacity": 40_000}
MCMC = VANILLA | {"strategy": "mcmc", "resolution": 256}


def record(training, seed=0, **more):
    return {
        "scene": "flat", "policy": "ours", "settings": {}, "seed": seed, "clock": "model",
        "sensing": {"fov": 60.0}, "snapshot": "seconds:60", "training": training,
        "machine": "a desk", "commit": "abc",
    } | more  # fmt: skip


def model(quality):
    """Four views, the second term of the error growing: the first is expected to be the best."""
    terms = np.zeros((4, len(TERMS)))
    terms[:, TERMS.index("unseen")] = [0.1, 0.2, 0.3, 0.4]
    columns = {name: np.asarray(quality, float) for name in ("psnr", "ssim")}
    columns |= {"lpips": -columns["psnr"], "R": np.array([0.1, 0.2, 0.3, 0.4])}
    return Model("m", "flat", "explored", terms, columns | {"coverage": np.ones(4)})


def test_a_flight_is_the_same_whoever_trains_on_it_and_another_with_another_seed():
    assert flight_of(record(VANILLA)) == flight_of(record(MCMC))
    assert flight_of(record(VANILLA)) != flight_of(record(VANILLA, seed=1))
    assert flight_of(record(VANILLA)) != flight_of(record(VANILLA, sensing={"fov": 90.0}))


def test_ranks_are_those_of_each_model():
    row = model_row(record(VANILLA), "vanilla", model([30, 25, 20, 10]))
    assert row["PSNR"] == 21.25
    for score in ("psnr", "ssim", "lpips"):
        assert row[f"expected error, {score}"] == 1.0
        assert row[f"R, {score}"] == -1.0
        assert row[f"coverage, {score}"] == 0.0  # it says nothing
    assert model_row(record(MCMC), "mcmc", model([10, 30, 20, 15]))["R, psnr"] == 0.2


def test_medians_are_those_of_a_training():
    models = {"vanilla": [[30, 25, 20, 10]], "mcmc": [[10, 20, 25, 30]] * 2}
    rows = [model_row(record({}), name, model(q)) for name, own in models.items() for q in own]
    found = {(line["training"], line["prediction"]): line for line in summary_rows(rows)}
    assert found["vanilla", "R"]["with psnr"].startswith("-1.00 [")
    assert found["mcmc", "R"]["with psnr"].startswith("1.00 [")
    assert found["mcmc", "expected error"]["models"] == 2


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A benchmark of these records, whose models need no images."""

    def write(records):
        text = "".join(json.dumps(record) + "\n" for record in records)
        (tmp_path / "cells.jsonl").write_text(text)
        monkeypatch.setattr(other_trainers, "judged_cell", lambda root, record, work: tmp_path)
        monkeypatch.setattr(other_trainers, "model_of", lambda path: model([30, 25, 20, 10]))
        return Options(tmp_path, out=tmp_path / "out", work=tmp_path)

    return write


def test_flights_that_were_trained_once_are_left_out_of_the_page(folder):
    options = folder([record(VANILLA), record(VANILLA, seed=1), record(MCMC)])
    page = (main(options) / "other_trainers.md").read_text()
    assert "| mcmc, 6,000 iterations at 256 px, 40,000 Gaussians | flat | ours | 0 |" in page
    assert "| flat | ours | 1 |" not in page


def test_without_a_second_trainer_there_is_nothing_to_compare(folder):
    with pytest.raises(SystemExit, match=r"no flight in .* was trained more than once"):
        main(folder([record(VANILLA), record(MCMC, seed=1)]))
