"""Tune settings of a policy with Optuna (pip install optuna): a trial is a cell of a benchmark.

Tune on scenes that no table reports. A trial that was done is not done again.
"""

from pathlib import Path

import numpy as np

import r3jax
from r3jax.cli.main import main

OUT = Path("runs/optuna")
TERMS = ("--scenes=apartment,gallery", "--seeds=0,1", "--budget=views:30", "--clock=model")


def objective(trial, terms=TERMS, out=OUT):
    """Explores, trains and evaluates with the settings of a trial; returns the mean PSNR [dB]."""
    given = {
        "lambda2": trial.suggest_float("lambda2", 0.1, 4.0, log=True),
        "num_candidates": trial.suggest_int("num_candidates", 40, 200),
    }
    settings = ["--settings", *(f"{name}={value}" for name, value in given.items())]
    assert main(["benchmark", "--policies=r3-pano", f"--out={out}", *terms, *settings]) == 0
    own = [record for record in r3jax.read_records(out) if record["settings"] == given]
    return float(np.mean([record["metrics"]["psnr"]["mean"] for record in own]))


if __name__ == "__main__":
    import optuna

    study = optuna.create_study(direction="maximize")
    study.optimize(objective, n_trials=30)
    print(study.best_params, study.best_value)
