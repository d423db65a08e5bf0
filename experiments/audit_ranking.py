"""Does an audit know which views a model will fail at? Every frame of a capture, held out once.

    python -m experiments.audit_ranking ../shared/recordings/hololens_lounge
    python -m experiments.audit_ranking runs/flat-ours-pano-seed0

The frames are dealt into folds; for each fold a vanilla 3DGS is trained on the others and evaluated
on its frames, and the audit evaluates the same frames by a map of the same others. Neither has seen
what it is asked about.
"""

import functools
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from matplotlib.figure import Figure
from scipy import stats

from experiments.pages.artifacts import (
    Origin,
    command_line,
    markdown_table,
    write_csv,
    write_figure,
    write_markdown,
)
from experiments.rank_statistics import partial_spearman, spearman
from r3jax.apps.audit.audit import audit
from r3jax.apps.audit.ground_plan import COLOR_OF_CAUSE
from r3jax.apps.audit.source import source_of
from r3jax.apps.audit.survey import AuditSettings
from r3jax.apps.benchmark.record import machine, source_commit
from r3jax.evaluation.evaluate import evaluate
from r3jax.files import write_atomic
from r3jax.formats.captures import Capture, open_capture
from r3jax.plots import style
from r3jax.splatting.training.config import TrainConfig
from r3jax.splatting.training.train import fit
from r3jax.splatting.views import Views, load_views

NAME = "audit_ranking"

PERMUTATIONS = 10_000
"""Orders at random that the coefficient is held against."""

WORST = 0.25
"""Share of the frames that count as the worst."""

SCORES = (
    "renderability", "coverage", "renderability of what is known", "bias", "noise", "resolution",
    "nearness",
)  # fmt: skip
"""What may rank the frames; the first is the audit's answer, the last a rule of thumb."""

ERRORS = ("psnr", "psnr_corrected", "ssim")
"""What they are ranked by."""


@dataclass(frozen=True)
class Options:
    """What to compare."""

    capture: Annotated[Path, tyro.conf.Positional]
    """A run or a recording with depth."""

    folds: int = 8
    """Models to train."""

    iterations: int = 1500
    """Steps of each training."""

    resolution: int = 160
    """Longer side of the images that are trained on and evaluated [px]."""

    gaussians: int = 20_000
    """At the start of each training; there may be twice as many."""

    out: Path = Path("experiments/results")
    """Folder of the results."""

    work: Path = Path("runs")
    """Folder of what is done so far: a call that was cut off goes on."""


def main(options: Options) -> Path:
    """Audits, trains, compares, and returns the folder of the results."""
    capture = open_capture(options.capture, "z")
    folder = options.out / NAME / capture.name
    rows = all_rows(capture, options)
    source = Origin(command_line(f"experiments.{NAME}"), machine(), source_commit() or "unknown")
    write_page(folder, capture, sorted(rows, key=lambda row: row["frame"]), options, source)
    print(f"results  {folder}")
    return folder


def all_rows(capture: Capture, options: Options) -> list[dict[str, Any]]:
    """A row for each frame; what is done is not done again."""
    work = options.work / NAME / capture.name
    scores = kept(work / "scores.json", {"folds": options.folds}, lambda: audited(capture, options))
    views = functools.cache(lambda: load_views(capture.frames(), options.resolution))
    poses = functools.cache(lambda: source_of(capture.source, capture.name).poses)
    rows: list[dict[str, Any]] = []
    for fold in range(options.folds):
        rows += kept(
            work / f"fold{fold}.json",
            settings(options),
            lambda k=fold: fold_rows(scores, poses(), views(), k, options),
        )
        print(f"fold {fold + 1} of {options.folds}", flush=True)
    return rows


def kept(
    path: Path, key: dict[str, Any], make: Callable[[], list[dict[str, Any]]]
) -> list[dict[str, Any]]:
    """Rows that an earlier call with the same settings has left; else they are made and left."""
    if path.exists():
        record = json.loads(path.read_bytes())
        if record["settings"] == key:
            return record["rows"]
    rows = make()
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, json.dumps({"settings": key, "rows": rows}, indent=1).encode())
    return rows


def audited(capture: Capture, options: Options) -> list[dict[str, Any]]:
    """What the audit says of every frame, in order."""
    everything = AuditSettings(folds=options.folds, num_views=0, max_frames=len(capture))
    found = audit(source_of(capture.source, capture.name), everything)
    folds = found.seen.fold_of.tolist()
    return [
        {"frame": frame.index, "fold": fold, **asdict(frame.score)}
        for frame, fold in zip(found.frames, folds, strict=True)
    ]


def settings(options: Options) -> dict[str, Any]:
    """What a fold depends on."""
    names = ("folds", "iterations", "resolution", "gaussians")
    return {name: getattr(options, name) for name in names}


def fold_rows(
    scores: list[dict[str, Any]], poses: np.ndarray, views: Views, fold: int, options: Options
) -> list[dict[str, Any]]:
    """A row for each frame of a fold: what the audit said, and how the render came out."""
    is_out = np.array([row["fold"] == fold for row in scores])
    held_out, others = np.flatnonzero(is_out), np.flatnonzero(~is_out)
    config = TrainConfig(iterations=options.iterations, num_gaussians=options.gaussians)
    scene = fit(views.take(others), config).scene
    test = views.take(held_out)
    evaluation = evaluate(scene, test, numbers=held_out.tolist())
    near = nearness(poses, held_out, others)
    rows: list[dict[str, Any]] = []
    for i, number in enumerate(held_out.tolist()):
        row = evaluation.rows[i]
        found = {
            "nearness": float(near[i]),
            "psnr": row.psnr,
            "psnr_corrected": corrected_psnr(evaluation.renders[i], np.asarray(test.rgb[i])),
            "ssim": row.ssim,
        }
        rows.append(scores[number] | found)
    return rows


def nearness(poses: np.ndarray, asked: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Minus the distance to the nearest other camera; a radian between axes counts one unit."""
    places, axes = poses[:, :3, 3], poses[:, :3, 2]
    distance = np.linalg.norm(places[asked][:, None] - places[others][None], axis=-1)
    cosine = np.clip(axes[asked] @ axes[others].T, -1.0, 1.0)
    return -(distance + np.arccos(cosine)).min(axis=1)


def corrected_psnr(render: np.ndarray, truth: np.ndarray) -> float:
    """PSNR once each channel was multiplied and shifted to fit the truth best.

    A camera that changes its exposure makes every render wrong, however well it was seen.

    Args:
        render: [H, W, 3] uint8.
        truth: [H, W, 3] uint8.
    """
    squares: list[float] = []
    for channel in range(3):
        x, y = (image[..., channel].reshape(-1) / 255.0 for image in (render, truth))
        design = np.stack([x, np.ones_like(x)], axis=1)
        gain = np.linalg.lstsq(design, y, rcond=None)[0]
        squares.append(float(np.mean((design @ gain - y) ** 2)))
    return float(-10.0 * np.log10(max(np.mean(squares), 1e-10)))


def permutation_p(score: np.ndarray, error: np.ndarray, seed: int = 0) -> float:
    """Share of random orders whose Spearman coefficient is at least that of the true one."""
    rank, other = stats.rankdata(score), stats.rankdata(error)
    rank, other = rank - rank.mean(), other - other.mean()
    rng = np.random.default_rng(seed)
    drawn = np.array([rng.permutation(rank) @ other for _ in range(PERMUTATIONS)])
    return float((1 + np.sum(drawn >= rank @ other - 1e-9)) / (1 + PERMUTATIONS))


def shift_p(score: np.ndarray, error: np.ndarray) -> float:
    """The same over circular shifts: neighbors of a video resemble each other in both columns."""
    rank, other = stats.rankdata(score), stats.rankdata(error)
    rank, other = rank - rank.mean(), other - other.mean()
    products = np.array([np.roll(rank, k) @ other for k in range(len(rank))])
    return float(np.mean(products >= products[0] - 1e-9))


def worst_found(score: np.ndarray, error: np.ndarray) -> tuple[int, int]:
    """Counts those of the worst quarter by error that are in the worst by score, and a quarter."""
    count = max(1, round(WORST * len(score)))
    worst = lambda x: set(np.argsort(x, kind="stable")[:count].tolist())
    return len(worst(score) & worst(error)), count


def comparison_rows(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Spearman of every score with every error, with intervals."""
    known = "renderability of what is known"
    rows = [row | {known: row["renderability"] / max(row["coverage"], 1e-9)} for row in rows]
    column = lambda name: np.array([row[name] for row in rows])
    table: list[dict[str, Any]] = []
    for score in SCORES:
        line: dict[str, Any] = {"score": score}
        for error in ERRORS:
            r = spearman(column(score), column(error))
            line[error] = f"{r.value:.2f} [{r.low:.2f}, {r.high:.2f}]"
        table.append(line)
    line = {"score": "renderability given coverage"}
    for error in ERRORS:
        r = partial_spearman(column("renderability"), column(error), [column("coverage")])
        line[error] = f"{r.value:.2f} [{r.low:.2f}, {r.high:.2f}]"
    return [*table, line]


def write_page(
    folder: Path, capture: Capture, rows: list[dict[str, Any]], options: Options, source: Origin
) -> None:
    """Writes the rows, the picture and the page."""
    folder.mkdir(parents=True, exist_ok=True)
    write_csv(folder / "frames.csv", rows, source)
    write_figure(folder / "ranking.png", ranking_figure(rows), source)
    score = np.array([row["renderability"] for row in rows])
    lines: list[str] = []
    for error in ERRORS:
        value = np.array([row[error] for row in rows])
        hits, count = worst_found(score, value)
        chance = count * count / len(rows)
        lines.append(
            f"- {error}: Spearman {spearman(score, value).value:.2f}; a random order does as well "
            f"with p = {permutation_p(score, value):.4f}, a circular shift of the sequence with "
            f"p = {shift_p(score, value):.3f}. Of the {count} worst renders {hits} are among the "
            f"{count} frames that the audit calls worst (by chance {chance:.1f})."
        )
        print(lines[-1])
    page = [
        f"# Audit against held-out renders: {capture.name}",
        f"{len(rows)} frames in {options.folds} folds; per fold a vanilla 3DGS of the other frames "
        f"({options.iterations} steps, {options.resolution} px) and a map of the same others. "
        "*psnr_corrected*: each channel of a render is first multiplied and shifted to fit the "
        "truth best, which takes changes of exposure away. *nearness*: minus the distance to the "
        "nearest training camera.",
        "\n".join(lines),
        "Spearman with 95 % bootstrap intervals over frames (neighboring frames resemble each "
        "other, so the intervals are too narrow):",
        markdown_table(comparison_rows(rows)),
        "![ranking](ranking.png)",
    ]
    write_markdown(folder / f"{NAME}.md", page, source)


def ranking_figure(rows: list[dict[str, Any]]) -> Figure:
    """Renderability against PSNR, a dot a frame; and both along the capture."""
    figure = style.new_figure(10.0, 3.8)
    left, right = figure.subplots(1, 2, width_ratios=[1.0, 1.5])
    score, psnr, frames = (
        np.array([row[name] for row in rows]) for name in ("renderability", "psnr", "frame")
    )
    colors = [COLOR_OF_CAUSE[row["cause"]] for row in rows]
    style.dress(left, "Each frame, held out", "renderability by the audit", "PSNR [dB]")
    left.scatter(score, psnr, c=colors, s=22)
    style.dress(right, "Along the capture", "frame", "PSNR [dB]")
    right.plot(frames, psnr, color=style.ACCENT, marker="o", markersize=3, label="PSNR")
    beside = right.twinx()
    beside.plot(frames, score, color=style.SECOND, marker="o", markersize=3)
    beside.set_ylabel("renderability", fontsize=9, color=style.SECOND)
    beside.tick_params(labelsize=8, colors=style.MUTED)
    return figure


if __name__ == "__main__":
    main(tyro.cli(Options))
