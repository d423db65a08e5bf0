"""Which frames of a capture to train on: `r3jax select` against choices by time, sharpness, pose.

    python -m experiments.select --captures LOUNGE runs/flat-walk --shares 0.1 0.2 0.4 --seeds 0 1 2

Every eighth frame of a capture judges and is on offer to no chooser. Each gets the others and a
number; a model is trained on what it chose and on nothing else, and judged by the held-out frames.
A seed is that of the training, and of `random`. The captures are named by the user; a walk through
an embedded scene is one, too:

    r3jax explore --scene flat --policy uniform --budget frames:140 --capture-every 0.3 \
        --clock model --resolution 256 --name flat-walk

`sharp-frames` is run for real (`--sharp-frames VENV/bin/sharp-frames`, an environment of its own,
version 0.4.0), on the pictures of the frames on offer. What is done in `--work` is not done again.
"""

import dataclasses
import json
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from PIL import Image

from experiments.pages.artifacts import joint_origin, markdown_table, write_markdown
from r3jax.apps.benchmark.record import machine
from r3jax.apps.select.select import select
from r3jax.apps.select.settings import SelectSettings
from r3jax.captures.source import Source, source_of
from r3jax.evaluation.evaluate import evaluate
from r3jax.files import make_folder, write_atomic
from r3jax.formats.captures import Capture, open_capture
from r3jax.frame import Frame
from r3jax.planning.candidates import spread
from r3jax.runs.reader import Run
from r3jax.splatting.training.config import TrainConfig
from r3jax.splatting.training.train import fit
from r3jax.splatting.views import load_views, split_views

NAME = "select"
CHOOSERS = ("select", "uniform", "random", "sharp-frames", "sharpest of each bucket", "farthest")


@dataclasses.dataclass(frozen=True)
class Options:
    """Compares choices of frames by what is trained on them."""

    captures: tuple[Path, ...]
    """What `r3jax audit` reads, with depth."""

    shares: tuple[float, ...] = (0.05, 0.1, 0.2, 0.4)
    """Of the frames on offer."""

    counts: tuple[int, ...] = ()
    """Numbers of frames, in place of shares."""

    choosers: tuple[str, ...] = CHOOSERS

    seeds: tuple[int, ...] = (0, 1, 2)

    iterations: int = 6000

    resolution: int = 240
    """Longer side of the images that are trained on and judged [px]."""

    gaussians: int = 20_000

    sharp_frames: str = "sharp-frames"
    """The program, version 0.4.0."""

    hold_out: int = 8

    work: Path = Path("runs/select-cells")

    out: Path = Path("experiments/results/select")


@dataclasses.dataclass(frozen=True)
class Pool:
    """A capture whose frames are on offer, but for those that judge."""

    capture: Capture
    source: Source
    offered: np.ndarray
    judging: np.ndarray

    def frame(self, number: int) -> Frame:
        """A frame at its full size."""
        source = self.capture.source
        return source.frame(source.rows[number].step if isinstance(source, Run) else number)


def open_pool(path: Path, hold_out: int) -> Pool:
    """Opens a capture."""
    capture = open_capture(path, "z")
    source = source_of(capture.source, capture.name)
    offered, judging = split_views(len(source), hold_out)
    return Pool(capture, source, offered, judging)


def by_select(pool: Pool, num: int, seed: int, options: Options) -> np.ndarray:
    """As `r3jax select --frames`, of the frames on offer."""
    del seed, options
    return select(_part(pool), SelectSettings(frames=num)).kept


def _part(pool: Pool) -> Source:
    """The frames on offer as a capture."""
    source, offered = pool.source, pool.offered
    return dataclasses.replace(
        source,
        poses=source.poses[offered],
        lenses=tuple(source.lenses[i] for i in offered),
        labels=tuple(source.labels[i] for i in offered),
        read=lambda index: source.read(int(offered[index])),
    )


def by_time(pool: Pool, num: int, seed: int, options: Options) -> np.ndarray:
    """Evenly spaced in the order of the capture."""
    del seed, options
    return np.unique(np.linspace(0, len(pool.offered) - 1, num).round().astype(int))


def by_chance(pool: Pool, num: int, seed: int, options: Options) -> np.ndarray:
    """At random."""
    del options
    return np.sort(np.random.default_rng(seed).choice(len(pool.offered), num, replace=False))


def by_sharp_frames(pool: Pool, num: int, seed: int, options: Options) -> np.ndarray:
    """The program `sharp-frames` with its defaults, on the pictures on offer."""
    del seed
    with tempfile.TemporaryDirectory(prefix="r3jax-") as scratch:
        pictures, out = Path(scratch) / "in", Path(scratch) / "out"
        _write_pictures(pool, pictures)
        command = [options.sharp_frames, str(pictures), str(out), "--num-frames", str(num),
                   "--format", "png", "--force-overwrite"]  # fmt: skip
        subprocess.run(command, check=True, capture_output=True)
        found = json.loads((out / "selected_metadata.json").read_text())["selected_items"]
    return np.sort([int(Path(item["original_id"]).stem) for item in found])


def by_buckets(pool: Pool, num: int, seed: int, options: Options) -> np.ndarray:
    """The sharpest of each of `num` equal stretches, by the variance of the Laplacian."""
    del seed, options
    sharp = np.array([_laplacian(pool.source.read(int(i))[0]) for i in pool.offered])
    parts = np.array_split(np.arange(len(sharp)), num)
    return np.array([int(part[np.argmax(sharp[part])]) for part in parts])


def by_poses(pool: Pool, num: int, seed: int, options: Options) -> np.ndarray:
    """Farthest-point sampling of positions and directions (a meter counts as a radian)."""
    del seed, options
    poses = pool.source.poses[pool.offered]
    return np.sort(spread(np.concatenate([poses[:, :3, 3], poses[:, :3, 2]], axis=1), num))


def _laplacian(rgb: np.ndarray) -> float:
    gray = rgb.mean(axis=2)
    lap = -4.0 * gray[1:-1, 1:-1] + gray[:-2, 1:-1] + gray[2:, 1:-1]
    return float((lap + gray[1:-1, :-2] + gray[1:-1, 2:]).var())


def _write_pictures(pool: Pool, folder: Path) -> None:
    folder.mkdir(parents=True)
    for number, index in enumerate(pool.offered.tolist()):
        rgb = np.rint(255.0 * np.asarray(pool.frame(index).rgb)).astype(np.uint8)
        Image.fromarray(rgb).save(folder / f"{number:05d}.png")


Chooser = Callable[[Pool, int, int, Options], np.ndarray]
CHOICES: dict[str, Chooser] = dict(
    zip(CHOOSERS, (by_select, by_time, by_chance, by_sharp_frames, by_buckets, by_poses),
        strict=True)
)  # fmt: skip


def run_cell(pool: Pool, chooser: str, num: int, seed: int, options: Options) -> dict[str, Any]:
    """Chooses, trains and judges, or takes over what was done before."""
    name = f"{pool.source.name}-{chooser.replace(' ', '_')}-{num}-{seed}-{options.iterations}"
    path = options.work / f"{name}.json"
    if path.exists():
        return json.loads(path.read_text())
    begin = time.perf_counter()
    chosen = pool.offered[CHOICES[chooser](pool, num, seed, options)]
    seconds = time.perf_counter() - begin
    views = load_views([pool.frame(i) for i in chosen.tolist()], options.resolution)
    config = TrainConfig(iterations=options.iterations, num_gaussians=options.gaussians, seed=seed)
    begin = time.perf_counter()
    model = fit(views, config).scene
    training = time.perf_counter() - begin
    test = load_views([pool.frame(i) for i in pool.judging.tolist()], options.resolution)
    rows = evaluate(model, test).rows
    record = {
        "capture": pool.source.name, "offered": len(pool.offered), "chooser": chooser,
        "frames": num, "kept": len(chosen), "seed": seed, "iterations": options.iterations,
        "resolution": options.resolution, "chosen": chosen.tolist(),
        "psnr": [float(row.psnr) for row in rows], "ssim": [float(row.ssim) for row in rows],
        "seconds_choosing": seconds, "seconds_training": training, "machine": machine(),
    }  # fmt: skip
    make_folder(options.work)
    write_atomic(path, json.dumps(record).encode())
    return record


def table(records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Mean PSNR over seeds and held-out frames, their worst tenth, SSIM and seconds."""
    keys = dict.fromkeys((r["capture"], r["offered"], r["frames"], r["chooser"]) for r in records)
    rows: list[dict[str, Any]] = []
    for key in keys:
        own = [r for r in records if (r["capture"], r["offered"], r["frames"], r["chooser"]) == key]
        worst = np.mean([np.percentile(r["psnr"], 10) for r in own])
        rows.append({
            "capture": key[0], "frames": f"{key[2]} of {key[1]}", "chooser": key[3],
            "kept": own[0]["kept"], "seeds": len(own),
            "PSNR": f"{np.mean([np.mean(r['psnr']) for r in own]):.2f}",
            "10th percentile": f"{worst:.2f}",
            "SSIM": f"{np.mean([np.mean(r['ssim']) for r in own]):.3f}",
            "choosing [s]": f"{np.mean([r['seconds_choosing'] for r in own]):.0f}",
            "training [s]": f"{np.mean([r['seconds_training'] for r in own]):.0f}",
        })  # fmt: skip
    return rows


def lazy_against_exact(path: Path, num: int) -> dict[str, Any]:
    """How often lazy and exact greedy differ on a capture, and what it costs."""
    found = select(source_of((opened := open_capture(path, "z")).source, opened.name),
                   SelectSettings(frames=num))  # fmt: skip
    exact = select(source_of(opened.source, opened.name), SelectSettings(frames=num, exact=True))
    return {
        "capture": opened.name, "frames": num,
        "in common": len(np.intersect1d(found.kept, exact.kept)),
        "lazy": f"{found.choice.objective[-1]:.5f}", "exact": f"{exact.choice.objective[-1]:.5f}",
    }  # fmt: skip


def main(options: Options) -> None:
    """Runs what is left, and writes the table."""
    records: list[dict[str, Any]] = []
    for path in options.captures:
        pool = open_pool(path, options.hold_out)
        shares = [max(2, round(share * len(pool.offered))) for share in options.shares]
        for num in options.counts or shares:
            for chooser in options.choosers:
                for seed in options.seeds:
                    record = run_cell(pool, chooser, num, seed, options)
                    records.append(record)
                    print(f"{record['capture']}, {num} by {chooser}, seed {seed}: "
                          f"{np.mean(record['psnr']):.2f} dB", flush=True)  # fmt: skip
    make_folder(options.out)
    origin = joint_origin("experiments.select", [r["machine"] for r in records], [None])
    lines = "\n".join(json.dumps(record) for record in records)
    write_atomic(options.out / "records.jsonl", f"{lines}\n".encode())
    write_markdown(options.out / "select.md", [markdown_table(table(records))], origin)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
