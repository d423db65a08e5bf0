"""The photo-pool protocol: which policy chooses the better photos of a real capture.

    python -m experiments.photo_pools --size smoke --photos LOUNGE runs/flat-uniform

The captures are named by the user. A walk through an embedded scene is one, too:

    r3jax explore --scene flat --policy uniform --budget frames:100 --capture-every 0.5 \
        --clock model --resolution 256 --name flat-uniform
"""

import csv
import io
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import tyro

from experiments.pages.artifacts import joint_origin, markdown_table, write_markdown
from r3jax.apps.benchmark.photos.pool import open_pool
from r3jax.apps.benchmark.photos.protocol import PhotoTerms
from r3jax.apps.benchmark.photos.records import load_or_compute, table_rows
from r3jax.files import write_atomic

NAME = "photo_pools"

SizeName = Literal["smoke", "small", "paper"]


@dataclass(frozen=True)
class Size:
    """How much is chosen and trained."""

    seeds: tuple[int, ...]
    resolution: int
    """Longer side of the images that are trained on and judged [px]."""

    terms: PhotoTerms


SIZES: dict[SizeName, Size] = {
    "smoke": Size((0,), 64, PhotoTerms(choose=4, every=50, iterations=200, gaussians=3_000)),
    "small": Size(
        (0, 1, 2),
        96,
        PhotoTerms(choose=10, iterations=500, gaussians=6_000, capacity=12_000),
    ),
    "paper": Size(
        (0, 1, 2),
        1600,
        PhotoTerms(choose=20, iterations=26_000, gaussians=100_000, capacity=400_000),
    ),
}
"""A minute; an hour on two cores; many hours on a GPU."""


@dataclass(frozen=True)
class Options:
    """Choice among the nearest photos of a capture, one per fixed number of training steps."""

    photos: tuple[Path, ...]
    """Captures with depth: whatever `r3jax train` opens."""

    size: SizeName = "smoke"
    """How much is done."""

    choosers: tuple[str, ...] = ("r3", "cover", "gavis", "fisherrf", "random")
    """The choosers."""

    seeds: tuple[int, ...] = ()
    """By default those of the size."""

    out: Path = Path("experiments/results")
    """Folder of the results; they go into a folder named after the experiment and the size."""

    work: Path = Path("runs/photo_pools")
    """Folder of what is done already: it is not done again."""


def main(options: Options) -> Path:
    """Chooses, trains and judges, writes the results, and returns their folder."""
    size = SIZES[options.size]
    records: list[dict[str, Any]] = []
    seeds = options.seeds or size.seeds
    pools = [open_pool(path, size.resolution) for path in options.photos]
    # Seeds outside: what is cut short has compared all choosers on the same seeds.
    for seed in seeds:
        for pool in pools:
            for chooser in options.choosers:
                record = load_or_compute(options.work, pool, chooser, size.terms, seed)
                records.append(record)
                psnr = record["metrics"]["psnr"]["mean"]
                print(f"{pool.name} {chooser} seed {seed}: {psnr:.2f} dB", flush=True)
    folder = options.out / NAME / options.size
    folder.mkdir(parents=True, exist_ok=True)
    commits = [record["commit"] for record in records]
    origin = joint_origin(f"experiments.{NAME}", [record["machine"] for record in records], commits)
    # The places of captures are this machine's business.
    command = origin.command
    for path in (*options.photos, options.work):
        command = command.replace(str(path), path.name)
    write_atomic(folder / "records.json", (json.dumps(records, indent=1) + "\n").encode())
    _write_csv(folder / "photo_pools.csv", records)
    origin = replace(origin, command=command)
    write_markdown(folder / "photo_pools.md", _page(size, records), origin)
    print(f"results  {folder}")
    return folder


def _page(size: Size, records: list[dict[str, Any]]) -> list[str]:
    """Returns the tables: each capture, and all."""
    num_seeds = len({record["seed"] for record in records})
    terms, captures = size.terms, list(dict.fromkeys(record["capture"] for record in records))
    page = [
        f"# Photo pools ({', '.join(captures)})",
        f"{terms.first} photos at first, {terms.choose} chosen among the {terms.nearest} nearest, "
        f"one every {terms.every} steps, {terms.iterations} steps after the last; images of "
        f"{size.resolution} px, {terms.gaussians} Gaussians from the photos. PSNR with its 95 % "
        f"interval over the photos that judge and {num_seeds} seeds; `minus random` pairs "
        "photos and seeds.",
    ]
    for capture in captures:
        own = [record for record in records if record["capture"] == capture]
        judging, all_photos = len(own[0]["test"]), own[0]["photos"]
        page.append(f"**{capture}**, {all_photos} photos, {judging} of them judge")
        page.append(markdown_table(table_rows(own)))
    if len(captures) > 1:
        page += ["**All**, every capture weighs the same", markdown_table(table_rows(records))]
    return page


def _write_csv(path: Path, records: list[dict[str, Any]]) -> None:
    """A row per run."""
    text = io.StringIO()
    names = ["capture", "chooser", "seed", "psnr", "ssim", "gaussians", "chosen"]
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    for record in records:
        metrics = {name: round(record["metrics"][name]["mean"], 4) for name in ("psnr", "ssim")}
        row = {name: record[name] for name in ("capture", "chooser", "seed", "gaussians")}
        writer.writerow(row | metrics | {"chosen": " ".join(map(str, record["chosen"]))})
    write_atomic(path, text.getvalue().encode())


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
