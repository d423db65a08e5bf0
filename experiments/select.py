"""Which frames of a capture to train on: `r3jax select` against choices by time, sharpness, pose.

    python -m experiments.select --captures LOUNGE runs/walks/flat --seeds 0 1 2

Every eighth frame of a capture judges and is on offer to no chooser. Each gets the others and a
number; a model is trained on what it chose and on nothing else, and judged by the held-out frames.
A seed is that of the training, and of the choosers that draw or train (`SEEDED`). The captures are
named by the user: whatever `r3jax select` reads, or walks of `experiments.hand_walks`.

`sharp-frames` is run for real (`--sharp-frames VENV/bin/sharp-frames`, an environment of its own,
version 0.4.0), on the pictures of the frames on offer. What stands in `records.jsonl` of `--out`
is not done again, so that a run may be stopped at any time; `--only-table` writes the table alone.
"""

import dataclasses
import functools
import json
import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import tyro
from PIL import Image

from experiments.pages.artifacts import joint_origin, markdown_table, write_markdown
from experiments.photo_rivals import by_fisher, by_gavis
from r3jax.apps.benchmark.record import machine, source_commit
from r3jax.apps.select.select import Selected, select
from r3jax.apps.select.settings import SelectSettings
from r3jax.captures.alignment import evenly_spaced
from r3jax.captures.source import Source, source_of
from r3jax.captures.surfaces import with_surfaces
from r3jax.captures.survey import Survey, survey_of
from r3jax.errors import InputError
from r3jax.evaluation.comparison import Estimate, mean_over_scenes, paired_difference
from r3jax.evaluation.evaluate import ImageMetric, evaluate
from r3jax.evaluation.image_metrics import load_lpips
from r3jax.files import append_line, make_folder
from r3jax.formats.captures import open_capture
from r3jax.planning.candidates import spread
from r3jax.splatting.backend import RasterConfig
from r3jax.splatting.scene import GaussianScene
from r3jax.splatting.training.config import TrainConfig
from r3jax.splatting.training.initialize import initialize
from r3jax.splatting.training.train import fit
from r3jax.splatting.views import Views, load_views, split_views

NAME = "select"

METRIC = "exposed"
"""PSNR after the gain of each color channel that fits best, as trainers that correct colors report
it: where exposure drifts, plain PSNR says mostly which frame's exposure a model has learned."""

Record = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Options:
    """Compares choices of frames by what is trained on them."""

    captures: tuple[Path, ...] = ()
    """What `r3jax select` reads."""

    shares: tuple[float, ...] = (0.2, 0.1, 0.05, 0.4)
    """Of the frames on offer, in the order in which they are run: two by two."""

    choosers: tuple[str, ...] = (
        "select", "uniform", "random", "sharp-frames", "sharpest of each bucket", "farthest",
        "fisherrf", "gavis", "all",
    )  # fmt: skip
    """Of `CHOICES`; `all` trains on all frames on offer."""

    seeds: tuple[int, ...] = (0, 1, 2)

    iterations: int = 6000

    resolution: int = 240
    """Longer side of the images that are trained on and judged [px]."""

    gaussians: int = 20_000
    """At the start of a training."""

    most: int = 140
    """Frames of a capture at most, evenly spread."""

    sharp_frames: str = "sharp-frames"
    """The program, version 0.4.0."""

    hold_out: int = 8

    lpips: bool = True

    only_table: bool = False
    """Train nothing: write the table of the records that are there."""

    out: Path = Path("experiments/results/select")


@dataclasses.dataclass(frozen=True)
class Pool:
    """A capture whose frames are on offer, but for those that judge."""

    name: str
    source: Source
    survey: Survey
    views: Views
    """All frames, as they are trained on and judged."""

    offered: np.ndarray
    judging: np.ndarray


def open_pool(path: Path, options: Options) -> Pool:
    """Opens a capture, with depth swept from its photos where it has none."""
    capture = open_capture(path, "z")
    source = source_of(capture.source, path.name)
    source = with_surfaces(part(source, evenly_spaced(len(source), options.most)))
    survey = survey_of(source, SelectSettings())
    frames = (source.frame(i, survey.alignment) for i in range(len(source)))
    views = load_views(frames, options.resolution)
    return Pool(path.name, source, survey, views, *split_views(len(source), options.hold_out))


def part(source: Source, numbers: np.ndarray) -> Source:
    """Some frames of a capture as a capture."""
    photograph = source.photograph
    return dataclasses.replace(
        source,
        poses=source.poses[numbers],
        lenses=tuple(source.lenses[i] for i in numbers),
        labels=tuple(source.labels[i] for i in numbers),
        read=lambda index: source.read(int(numbers[index])),
        photograph=None
        if photograph is None
        else lambda index, by: photograph(int(numbers[index]), by),
    )


def _select(pool: Pool, num: int, seed: int, options: Options) -> np.ndarray:
    """As `r3jax select --frames`, of the frames on offer."""
    del seed, options
    found = _SELECTED.get(pool.name)
    if found is None or found.scenes.max() > 0 or len(found.choice.order) < num:
        found = select(part(pool.source, pool.offered), SelectSettings(frames=num))
        _SELECTED[pool.name] = found
    return found.used[found.choice.order[:num]]


_SELECTED: dict[str, Selected] = {}
"""The latest selection of each capture: fewer frames of one scene are the first of more."""


def _uniform(pool: Pool, num: int, seed: int, options: Options) -> np.ndarray:
    """Evenly spaced in the order of the capture."""
    del seed, options
    return evenly_spaced(len(pool.offered), num)


def _random(pool: Pool, num: int, seed: int, options: Options) -> np.ndarray:
    del options
    return np.random.default_rng(seed).choice(len(pool.offered), num, replace=False)


def _sharp_frames(pool: Pool, num: int, seed: int, options: Options) -> np.ndarray:
    """The program `sharp-frames` with its defaults, on the pictures on offer."""
    del seed
    with tempfile.TemporaryDirectory(prefix="r3jax-") as scratch:
        pictures, out = Path(scratch) / "in", Path(scratch) / "out"
        pictures.mkdir()
        for number, index in enumerate(pool.offered.tolist()):
            Image.fromarray(pool.source.read(index)[0]).save(pictures / f"{number:05d}.png")
        command = [options.sharp_frames, str(pictures), str(out), "--num-frames", str(num),
                   "--format", "png", "--force-overwrite"]  # fmt: skip
        subprocess.run(command, check=True, capture_output=True)
        found = json.loads((out / "selected_metadata.json").read_text())["selected_items"]
    return np.array([int(Path(item["original_id"]).stem) for item in found])


def _buckets(pool: Pool, num: int, seed: int, options: Options) -> np.ndarray:
    """The sharpest of each of `num` equal stretches, by the variance of the Laplacian."""
    del seed, options
    sharp = np.array([_laplacian(pool.source.read(int(i))[0]) for i in pool.offered])
    parts = np.array_split(np.arange(len(sharp)), num)
    return np.array([int(part[np.argmax(sharp[part])]) for part in parts])


def _laplacian(rgb: np.ndarray) -> float:
    gray = rgb.mean(axis=2)
    lap = -4.0 * gray[1:-1, 1:-1] + gray[:-2, 1:-1] + gray[2:, 1:-1]
    return float((lap + gray[1:-1, :-2] + gray[1:-1, 2:]).var())


def _farthest(pool: Pool, num: int, seed: int, options: Options) -> np.ndarray:
    """Farthest-point sampling of positions and directions (an audit's meter is a radian)."""
    del seed, options
    poses = pool.survey.alignment.poses(pool.source.poses[pool.offered])
    return np.array(spread(np.concatenate([poses[:, :3, 3], poses[:, :3, 2]], axis=1), num))


def _fisherrf(pool: Pool, num: int, seed: int, options: Options) -> np.ndarray:
    return by_fisher(pool.views.take(pool.offered), num, seed, options.gaussians)


def _gavis(pool: Pool, num: int, seed: int, options: Options) -> np.ndarray:
    del options
    return by_gavis(pool.source, pool.survey, pool.offered.tolist(), num, seed)


def _all(pool: Pool, num: int, seed: int, options: Options) -> np.ndarray:
    del num, seed, options
    return np.arange(len(pool.offered))


CHOICES: dict[str, Callable[[Pool, int, int, Options], np.ndarray]] = {
    "select": _select, "uniform": _uniform, "random": _random, "sharp-frames": _sharp_frames,
    "sharpest of each bucket": _buckets, "farthest": _farthest, "fisherrf": _fisherrf,
    "gavis": _gavis, "all": _all,
}  # fmt: skip
"""Return numbers among the frames on offer."""

SEEDED = ("random", "fisherrf", "gavis")
"""Choosers that choose otherwise with another seed."""


class Cell(NamedTuple):
    """One training."""

    capture: str
    chooser: str
    share: float
    seed: int
    iterations: int
    resolution: int


_KEY = Cell._fields


def cells(options: Options) -> Iterator[tuple[Path, Cell]]:
    """All trainings, in an order in which what is cut short has compared all choosers."""
    terms = (options.iterations, options.resolution)
    for begin in range(0, len(options.shares), 2):
        for seed in options.seeds:
            for share in options.shares[begin : begin + 2]:
                for path in options.captures:
                    for chooser in options.choosers:
                        size = 1.0 if chooser == "all" else share
                        yield path, Cell(path.name, chooser, size, seed, *terms)


def read_records(path: Path) -> dict[Cell, Record]:
    """Reads what is done."""
    lines = path.read_text().splitlines() if path.exists() else []
    found = [json.loads(line) for line in lines]
    return {Cell(*(record[name] for name in _KEY)): record for record in found}


def run_cell(
    pool: Pool, cell: Cell, done: dict[Cell, Record], options: Options, lpips: ImageMetric | None
) -> Record:
    """Chooses, trains and judges."""
    chosen, choosing = _chosen(pool, cell, done, options)
    # Sorted: the training draws by number, and the order of a choice is no part of it.
    numbers = pool.offered[np.sort(chosen)]
    watch = _Watch()
    model = trained(pool.views.take(numbers), cell, options.gaussians)
    training = watch.seconds()
    judging = pool.views.take(pool.judging)
    found = evaluate(model, judging, lpips=lpips)
    columns = {
        name: [round(float(v), 4) for row in found.rows if (v := getattr(row, name)) is not None]
        for name in ("psnr", "ssim", "lpips")
    }
    columns["exposed"] = [
        round(exposed_psnr(*pair), 4)
        for pair in zip(found.renders, np.asarray(judging.rgb), strict=True)
    ]
    return {
        **cell._asdict(), "offered": len(pool.offered), "kept": len(numbers),
        "chosen": numbers.tolist(), **columns, "choosing": choosing, "training": training,
        "gaussians": options.gaussians, "commit": source_commit(), "machine": machine(),
    }  # fmt: skip


def exposed_psnr(render: np.ndarray, truth: np.ndarray) -> float:
    """PSNR after the gain of each channel that fits best [dB]: exposures differ between frames.

    Args:
        render: [H, W, 3] uint8.
        truth: the same.
    """
    a, b = render.astype(np.float64), truth.astype(np.float64)
    gain = (a * b).sum(axis=(0, 1)) / np.maximum((a * a).sum(axis=(0, 1)), 1.0)
    error = np.mean((np.minimum(gain * a, 255.0) - b) ** 2)
    return float(20.0 * np.log10(255.0 / np.sqrt(max(error, 1e-3))))


_SHOWN = 512
"""Views of a training: copies of the frames, so that one program trains on any number of them."""


def trained(views: Views, cell: Cell, gaussians: int) -> GaussianScene:
    """Trains on some frames; each is shown as often as any other, or once more a round."""
    config = TrainConfig(
        iterations=cell.iterations, num_gaussians=gaussians, seed=cell.seed,
        raster=RasterConfig().with_room(_PAIRS * gaussians),
    )  # fmt: skip
    key = jax.random.key(cell.seed)
    scene = initialize(views, gaussians, config.rows, config.sh_degree, key=key)
    order = np.random.default_rng(cell.seed).permutation(len(views))
    copies = views.take(np.resize(order, max(_SHOWN, len(views))))
    return fit(copies, config, scene=scene).scene


_PAIRS = 32
"""Intersections of a Gaussian with tiles: room from the beginning, as more is another program."""


def _chosen(
    pool: Pool, cell: Cell, done: dict[Cell, Record], options: Options
) -> tuple[np.ndarray, dict[str, float]]:
    """Returns the choice of a cell, as another seed has made it where seeds do not matter."""
    for other, record in done.items():
        if cell.chooser not in SEEDED and other[:3] == cell[:3]:
            return np.searchsorted(pool.offered, record["chosen"]), record["choosing"]
    watch = _Watch()
    num = max(2, round(cell.share * len(pool.offered)))
    return CHOICES[cell.chooser](pool, num, cell.seed, options), watch.seconds()


class _Watch:
    """Seconds on the clock and of all processors since it was made."""

    def __init__(self):
        self._begin = self._now()

    @staticmethod
    def _now() -> np.ndarray:
        return np.array([time.perf_counter(), sum(os.times()[:4])])

    def seconds(self) -> dict[str, float]:
        """Returns both."""
        wall, cpu = (self._now() - self._begin).round(2).tolist()
        return {"wall": wall, "cpu": cpu}


def run(options: Options, path: Path) -> None:
    """Runs what is left, one record a line."""
    lpips = load_lpips() if options.lpips else None
    opened = functools.cache(lambda path: open_pool(path, options))
    for capture, cell in cells(options):
        done = read_records(path)
        if cell not in done:
            record = run_cell(opened(capture), cell, done, options, lpips)
            append_line(path, json.dumps(record))
            print(f"{cell.capture}, {cell.share:g} by {cell.chooser}, seed {cell.seed}: "
                  f"{np.mean(record['psnr']):.2f} dB, {record['training']['cpu']:.0f} s",
                  flush=True)  # fmt: skip


def compared(
    records: Sequence[Record], share: float, choosers: Sequence[str]
) -> tuple[list[Record], list[str]]:
    """Records of some choosers at a share, and the captures on which all of them are done.

    Means over different captures could not be compared.
    """
    at = [r for r in records if r["share"] in (share, 1.0) and r["chooser"] in choosers]
    captures = list(dict.fromkeys(r["capture"] for r in at))
    done = lambda capture: {r["chooser"] for r in at if r["capture"] == capture}
    captures = [capture for capture in captures if done(capture) == set(choosers)]
    return [r for r in at if r["capture"] in captures], captures


def comparable(records: Sequence[Record], share: float) -> list[list[str]]:
    """Groups choosers by the captures on which all of a group are done, most captures first."""
    done: dict[str, set[str]] = {}
    for record in records:
        if record["share"] in (share, 1.0):
            done.setdefault(record["chooser"], set()).add(record["capture"])
    sets = {frozenset(captures) for chooser, captures in done.items() if chooser != "all"}
    by_size = sorted(sets, key=lambda captures: (-len(captures), sorted(captures)))
    return [[c for c in done if done[c] >= captures] for captures in by_size]


def table(at: Sequence[Record]) -> list[dict[str, Any]]:
    """One row per chooser, the best first: means over the captures, with intervals."""
    rows: list[tuple[float, dict[str, Any]]] = []
    for chooser in dict.fromkeys(r["chooser"] for r in at):
        own = [r for r in at if r["chooser"] == chooser]
        psnr = mean_over_scenes(_scores(own, METRIC))
        mean = functools.partial(_over_captures, own)
        row = {
            "chooser": chooser,
            "PSNR, colors corrected [dB]": _text(psnr),
            "minus all frames": lead(at, chooser, "all"),
            "select minus it": lead(at, "select", chooser),
            "worst tenth": f"{mean(_worst_tenth):.2f}",
            "PSNR": f"{mean(lambda record: np.mean(record['psnr'])):.2f}",
            "SSIM": f"{mean(lambda record: np.mean(record['ssim'])):.3f}",
            "LPIPS": f"{mean(lambda record: np.mean(record['lpips'])):.3f}"
            if all(r["lpips"] for r in own) else "–",
            "choosing [CPU s]": f"{np.median([r['choosing']['cpu'] for r in own]):.0f}",
            "training [CPU s]": f"{np.median([r['training']['cpu'] for r in own]):.0f}",
            "trainings": len(own),
        }  # fmt: skip
        rows.append((psnr.value, row))
    return [row for _, row in sorted(rows, key=lambda entry: -entry[0])]


def _worst_tenth(record: Record) -> float:
    """Mean of the worst tenth of the frames, at least two."""
    worst = np.sort(record[METRIC])[: max(2, round(0.1 * len(record[METRIC])))]
    return float(worst.mean())


def _over_captures(records: Sequence[Record], of: Callable[[Record], Any]) -> float:
    captures = dict.fromkeys(r["capture"] for r in records)
    return float(np.mean([np.mean([of(r) for r in records if r["capture"] == c])
                          for c in captures]))  # fmt: skip


def _scores(records: Sequence[Record], metric: str) -> dict[str, np.ndarray]:
    """One metric by capture, [seeds, held-out frames]."""
    captures = dict.fromkeys(r["capture"] for r in records)
    ordered = sorted(records, key=lambda r: r["seed"])
    return {c: np.array([r[metric] for r in ordered if r["capture"] == c]) for c in captures}


def difference(records: Sequence[Record], first: str, second: str) -> Estimate | None:
    """Corrected PSNR of a chooser minus another's, same frames, captures and seeds [dB]."""
    runs = lambda name: {(r["capture"], r["seed"]): r for r in records if r["chooser"] == name}
    ours, theirs = runs(first), runs(second)
    both = sorted(set(ours) & set(theirs))
    if first == second or not both:
        return None
    pair = [_scores([runs[key] for key in both], METRIC) for runs in (ours, theirs)]
    return paired_difference(pair[0], pair[1])


def lead(records: Sequence[Record], first: str, second: str) -> str:
    """The same as text; nothing where the two have no runs in common."""
    found = difference(records, first, second)
    return "" if found is None else _text(found, "+")


def _text(found: Estimate, sign: str = "") -> str:
    return f"{found.value:{sign}.2f} [{found.low:{sign}.2f}, {found.high:{sign}.2f}]"


def by_capture(
    records: Sequence[Record], share: float, metric: str = METRIC
) -> list[dict[str, Any]]:
    """Mean of a metric of each chooser on each capture at a share."""
    captures = list(dict.fromkeys(r["capture"] for r in records))
    rows: list[dict[str, Any]] = []
    for chooser in dict.fromkeys(r["chooser"] for r in records):
        own = [r for r in records if r["chooser"] == chooser and r["share"] in (share, 1.0)]
        row: dict[str, Any] = {"chooser": chooser}
        for capture in captures:
            found = [np.mean(r[metric]) for r in own if r["capture"] == capture and r.get(metric)]
            row[capture] = f"{np.mean(found):.2f}" if found else "–"
        if own:
            rows.append(row)
    return rows


def write_page(records: Sequence[Record], folder: Path) -> None:
    """Writes the tables of each share and number of iterations."""
    lines: list[str] = []
    for terms in dict.fromkeys((r["iterations"], r["resolution"]) for r in records):
        some = [r for r in records if (r["iterations"], r["resolution"]) == terms]
        for share in sorted({r["share"] for r in some} - {1.0}):
            lines.append(
                f"## {100 * share:g} % of the frames, {terms[0]} iterations at {terms[1]} px"
            )
            for choosers in comparable(some, share):
                at, captures = compared(some, share, choosers)
                lines += [f"Means over {', '.join(captures)}:", markdown_table(table(at))]
            lines += ["Colors corrected, by capture:", markdown_table(by_capture(some, share))]
            lines += ["Plain PSNR:", markdown_table(by_capture(some, share, "psnr"))]
    commits = [r["commit"] for r in records]
    origin = joint_origin(f"experiments.{NAME}", [r["machine"] for r in records], commits)
    write_markdown(folder / "tables.md", lines, origin)


def main(options: Options) -> None:
    """Runs what is left, and writes the tables."""
    if unknown := set(options.choosers) - set(CHOICES):
        raise InputError(f"unknown choosers: {', '.join(sorted(unknown))}")
    if not (options.captures or options.only_table):
        raise InputError("no captures: name them, or give --only-table")
    make_folder(options.out)
    path = options.out / "records.jsonl"
    if not options.only_table:
        run(options, path)
    write_page(list(read_records(path).values()), options.out)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
