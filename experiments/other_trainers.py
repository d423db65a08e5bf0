"""Does what ranks the views of one trainer's models rank those of another's? One map for both.

    python -m experiments.captures training --size small --seconds 60 --seeds 0
    python -m experiments.other_trainers runs/experiments/small-seconds

Flights that were trained more than once are compared: their maps, and so every prediction, are the
same; what differs are the models. The expected error is by the package's coefficients, which were
fitted on models of the first trainer.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from experiments.expected_error import Model, expected, median, model_of, rank
from experiments.judged_models import SCORES, judged_cell
from experiments.pages.artifacts import markdown_table, write_csv, write_markdown
from experiments.suite import origin
from r3jax.scoring.expected_error import DISSIMILARITY, SQUARED

NAME = "other_trainers"

PREDICTIONS = ("expected error", "R", "coverage")
"""What is held against the scores of the views."""


@dataclass(frozen=True)
class Options:
    """Which models."""

    cells: tyro.conf.Positional[Path]
    """Folder of a benchmark."""

    out: Path = Path("experiments/results")
    """Folder of the results."""

    work: Path = Path("runs/judged_models")
    """Folder of the models with their maps; what is there is not made again."""


def main(options: Options) -> Path:
    """Compares, writes the page, and returns the folder of the results."""
    lines = (options.cells / "cells.jsonl").read_text().splitlines()
    records = [json.loads(line) for line in lines]
    trained: dict[str, dict[str, Mapping[str, Any]]] = {}
    for record in records:
        trained.setdefault(flight_of(record), {})[training_of(record)] = record
    several = [own for own in trained.values() if len(own) > 1]
    if not several:
        raise SystemExit(f"no flight in {options.cells} was trained more than once")
    rows = [
        model_row(record, training, model_of(judged_cell(options.cells, record, options.work)))
        for own in several
        for training, record in own.items()
    ]
    used = [record for own in several for record in own.values()]
    folder, source = options.out / NAME, origin(f"experiments.{NAME}", used)
    folder.mkdir(parents=True, exist_ok=True)
    write_csv(folder / "models.csv", rows, source)
    page = [
        "Spearman within each model; medians over models with 95 % intervals of a bootstrap over "
        "models. *with LPIPS* the sign is changed.",
        markdown_table(summary_rows(rows)),
        "Model by model:",
        markdown_table(rows),
    ]
    write_markdown(folder / f"{NAME}.md", page, source)
    print(f"results  {folder}")
    return folder


def flight_of(record: Mapping[str, Any]) -> str:
    """What models of one map have in common."""
    names = ("scene", "policy", "settings", "seed", "sensing", "clock", "snapshot")
    return json.dumps([record[name] for name in names], sort_keys=True)


def training_of(record: Mapping[str, Any]) -> str:
    """How a model was trained, in words."""
    how = record["training"]
    size, steps = how["resolution"], how["iterations"]
    return f"{how['strategy']}, {steps:,} iterations at {size} px, {how['capacity']:,} Gaussians"


def model_row(record: Mapping[str, Any], training: str, model: Model) -> dict[str, Any]:
    """Spearman of every prediction with every score of one model."""
    row: dict[str, Any] = {
        "training": training,
        "scene": record["scene"],
        "policy": record["policy"],
        "seed": record["seed"],
        "PSNR": round(float(model.columns["psnr"].mean()), 2),
    }
    fits = {"psnr": SQUARED, "ssim": DISSIMILARITY, "lpips": DISSIMILARITY}
    for score in SCORES:
        quality = model.columns[score] * (-1.0 if score == "lpips" else 1.0)
        error = expected(model, np.array(fits[score].coefficients))
        for name in PREDICTIONS:
            prediction = -error if name == "expected error" else model.columns[name]
            row[f"{name}, {score}"] = round(rank(prediction, quality), 3)
    return row


def summary_rows(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Medians over the models of each training."""
    table: list[dict[str, Any]] = []
    for training in dict.fromkeys(row["training"] for row in rows):
        mine = [row for row in rows if row["training"] == training]
        for name in PREDICTIONS:
            line: dict[str, Any] = {"training": training, "models": len(mine), "prediction": name}
            line |= {f"with {score}": median(mine, f"{name}, {score}") for score in SCORES}
            table.append(line)
    return table


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
