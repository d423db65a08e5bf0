"""Records of the photo-pool protocol: one JSON file for a capture, a chooser and a seed."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from r3jax.apps.benchmark.photos.choosers import make_chooser
from r3jax.apps.benchmark.photos.pool import PhotoPool
from r3jax.apps.benchmark.photos.protocol import OnStage, Outcome, PhotoTerms, run_photos
from r3jax.apps.benchmark.record import machine, source_commit
from r3jax.evaluation.evaluate import ImageMetric
from r3jax.evaluation.scores import summarize
from r3jax.evaluation.statistics import Estimate, mean_over_scenes, paired_difference
from r3jax.files import make_folder, write_atomic
from r3jax.validation.files import read_bytes
from r3jax.validation.json_text import parse_json, sealed, unsealed

FORMAT = 1
"""Format version of a record."""

_MAX_BYTES = 64 << 20

Record = dict[str, Any]


def record_path(root: Path, pool: PhotoPool, chooser: str, seed: int) -> Path:
    """Returns the path of a run's record."""
    return root / "photos" / f"{pool.name}-{chooser}-seed{seed}.json"


def load_or_compute(
    root: Path,
    pool: PhotoPool,
    chooser: str,
    terms: PhotoTerms,
    seed: int,
    *,
    lpips: ImageMetric | None = None,
    on_stage: OnStage = lambda stage: None,
) -> Record:
    """Reads the stored record on equal terms; without one, runs the protocol and stores its record.

    Args:
        root: folder of the benchmark.
        pool: the photos.
        chooser: name of the method that chooses.
        terms: how many, how long.
        seed: of the run.
        lpips: the perceptual metric; left out by default.
        on_stage: told what happens now.

    Raises:
        ValueError: no chooser has that name, or the pool is too small.
        OSError: the record cannot be written.
    """
    path = record_path(root, pool, chooser, seed)
    asked = {
        "format": FORMAT,
        "capture": pool.name,
        "photos": len(pool.poses),
        "resolution": [pool.views.width, pool.views.height],
        "test": pool.test.tolist(),
        "chooser": chooser,
        "seed": seed,
        "terms": dataclasses.asdict(terms),
    }
    if path.exists():
        try:
            kept = parse_json(read_bytes(path, _MAX_BYTES))
            kept = unsealed(kept) if isinstance(kept, dict) else {}
        except ValueError:  # damaged: made again
            kept = {}
        if all(kept.get(name) == asked[name] for name in asked):
            return kept
    made = make_chooser(chooser, terms.nearest, terms.max_range)
    outcome = run_photos(pool, made, terms, seed, lpips=lpips, on_stage=on_stage)
    record = asked | _fields(outcome) | {"machine": machine(), "commit": source_commit()}
    make_folder(path.parent)
    write_atomic(path, (json.dumps(sealed(record)) + "\n").encode())
    return record


def _fields(outcome: Outcome) -> Record:
    """Returns the outcome of a run as plain numbers."""
    found = {summary.metric.name: summary for summary in summarize(outcome.rows)}
    return {
        "chosen": outcome.chosen,
        "choice_seconds": outcome.seconds,
        "gaussians": outcome.num_gaussians,
        "metrics": {
            name: {"mean": summary.mean, "percentile_5": summary.percentile_5}
            for name, summary in found.items()
        },
        "psnr": [row.psnr for row in outcome.rows],
        "ssim": [row.ssim for row in outcome.rows],
        "lpips": [row.lpips for row in outcome.rows],
    }


def table_rows(records: Sequence[Record]) -> list[dict[str, str]]:
    """Makes a table row per chooser, the best first: means with intervals, and gains over `random`.

    Args:
        records: of the same captures and seeds for all choosers.
    """
    choosers = list(dict.fromkeys(record["chooser"] for record in records))
    lines: list[tuple[float, dict[str, str]]] = []
    for chooser in choosers:
        own = [record for record in records if record["chooser"] == chooser]
        psnr = mean_over_scenes(_scores(own, "psnr"))
        line = {
            "chooser": chooser,
            "PSNR [dB]": _text(psnr),
            "5th percentile": f"{np.mean([r['metrics']['psnr']['percentile_5'] for r in own]):.2f}",
            "SSIM": f"{mean_over_scenes(_scores(own, 'ssim')).value:.3f}",
        }
        if all(value is not None for record in own for value in record["lpips"]):
            line["LPIPS"] = f"{mean_over_scenes(_scores(own, 'lpips')).value:.3f}"
        line["minus random"] = _lead(own, records) if chooser != "random" else ""
        # The first choice compiles, and is not what a choice takes.
        later = [s for record in own for s in record["choice_seconds"][1:]]
        line["seconds a choice"] = f"{np.median(later):.3f}" if later else ""
        lines.append((psnr.value, line))
    return [line for _, line in sorted(lines, key=lambda entry: -entry[0])]


def _lead(own: Sequence[Record], records: Sequence[Record]) -> str:
    """Writes a chooser's gain in PSNR over `random` on the same test photos [dB]."""
    floor = [record for record in records if record["chooser"] == "random"]
    runs = lambda part: sorted((record["capture"], record["seed"]) for record in part)
    if runs(floor) != runs(own):
        return ""
    return _text(paired_difference(_scores(own, "psnr"), _scores(floor, "psnr")), "+")


def _scores(records: Sequence[Record], metric: str) -> dict[str, np.ndarray]:
    """Collects one metric by capture, [seeds, test photos]."""
    captures = dict.fromkeys(record["capture"] for record in records)
    return {
        capture: np.array(
            [
                record[metric]
                for record in sorted(records, key=lambda record: record["seed"])
                if record["capture"] == capture
            ],
            dtype=np.float64,
        )
        for capture in captures
    }


def _text(found: Estimate, sign: str = "") -> str:
    return f"{found.value:{sign}.2f} [{found.low:{sign}.2f}, {found.high:{sign}.2f}]"
