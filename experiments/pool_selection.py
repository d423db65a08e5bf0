"""The choice without the loop: what the utilities alone achieve.

    python -m experiments.pool_selection --size smoke

One pool of poses in the reachable free space of a scene, the same first views for all, and no path
cost. A policy scores the whole pool, the best pose is taken, its frame joins the map, and so on.
Vanilla 3DGS is then trained from scratch on each choice and evaluated on the scene's test views.

The pool comes from the ground truth, the same for all; pictures come only from poses that were
chosen. What is left out has no score of a pose: `frontier`, and `ours-pano` and
`ours-ahead`, which turn poses and so would have another pool. `active-gamer` is its gain, the empty
pixels, without its lattice.
"""

import dataclasses
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import tyro

from experiments.pages.artifacts import (
    markdown_table,
    origin_of,
    write_csv,
    write_figure,
    write_markdown,
)
from experiments.pages.pool_figure import pool_figure
from experiments.pages.pool_table import gain_rows, mean_rows, result_rows
from experiments.pool_choice import choose, pool_of
from experiments.suite import HOUSE
from r3jax.apps.benchmark.photos.choosers import SCORED
from r3jax.apps.benchmark.record import machine, source_commit
from r3jax.evaluation.comparison import scene_title
from r3jax.evaluation.evaluate import evaluate
from r3jax.evaluation.scores import summarize
from r3jax.evaluation.test_views import load_view_set, render_view_set
from r3jax.files import write_atomic
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.simulators.free_space import GroundTruth
from r3jax.simulators.scenes.registry import open_scene
from r3jax.splatting.training import train
from r3jax.splatting.training.config import TrainConfig
from r3jax.splatting.views import Views, load_views

NAME = "pool_selection"


SizeName = Literal["smoke", "small", "house", "paper"]


@dataclass(frozen=True)
class Size:
    """How much is chosen, trained and evaluated."""

    scenes: tuple[str, ...]
    seeds: tuple[int, ...]
    pool: int
    first: int
    """Views that all choices begin with: the pool's first ones."""

    snapshots: tuple[int, ...]
    """Views at which a model is trained; the last is the number of views chosen."""

    resolution: int
    """Width and height of the images [px]."""

    train_resolution: int
    iterations: int
    gaussians: int
    test_views: int
    """At most."""


SIZES: dict[SizeName, Size] = {
    "smoke": Size(("flat",), (0,), 64, 3, (8, 16), 128, 48, 300, 4_000, 60),
    "small": Size(("flat", "office"), (0, 1), 250, 3, (30, 60), 256, 128, 1500, 20_000, 120),
    # What as many frames bring as `experiments.captures` takes in one and in two minutes, and twice
    # that, where no way has to be flown; trainings as long as there.
    "house": Size((HOUSE,), (0,), 1000, 3, (170, 300, 600), 256, 128, 6000, 20_000, 120),
    "paper": Size(
        ("flat", "apartment", "office", "gallery"),
        (0, 1, 2),
        500,
        3,
        (30, 60, 120, 300),
        512,
        512,
        7000,
        50_000,
        1000,
    ),
}
"""On two cores ten minutes, three hours, and seven minutes for `random` (a policy that scores poses
takes longer); many hours on a GPU."""


@dataclass(frozen=True)
class Options:
    """Greedy choice from a pool of poses by each policy's utility, without paths."""

    size: SizeName = "smoke"
    """How much is done: `smoke` in minutes, `small` in hours, `paper` on GPUs; `house` is one
    scene that is hard to cover, with long trainings."""

    policies: tuple[str, ...] = SCORED
    """Whose utility chooses."""

    known_cells: bool = False
    """Leave unexplored cells out of every utility: what the terms on known surfaces achieve.
    With them U_G decides most choices, as its weight is large in all policies."""

    out: Path = Path("experiments/results")
    """Folder of the results; they go into a folder named after the experiment and the size."""

    work: Path = Path("runs/pool_selection")
    """Folder of what is done already: it is not done again."""

    def __post_init__(self) -> None:
        """Refuses policies that have no score of a pose."""
        unknown = sorted(set(self.policies) - set(SCORED))
        if unknown or not self.policies:
            raise ValueError(
                f"--policies: {', '.join(unknown) or '(none given)'} cannot choose from a pool; "
                f"known: {', '.join(SCORED)}"
            )


@dataclass(frozen=True)
class Choice:
    """One row of work: a policy chooses in a scene."""

    policy: str
    scene: str
    seed: int
    size: Size
    known_cells: bool
    commit: str | None

    @property
    def file_name(self) -> str:
        """Where its record is kept."""
        kind = "known" if self.known_cells else "all"
        scene = scene_title(self.scene)
        return f"{scene}-{self.policy}-{self.size.pool}poses-{kind}-seed{self.seed}.json"


def main(options: Options) -> Path:
    """Chooses, trains and evaluates, writes the results, and returns their folder."""
    records = list(_records(options))
    folder = options.out / NAME / (options.size + ("-known-cells" if options.known_cells else ""))
    folder.mkdir(parents=True, exist_ok=True)
    origin, rows = origin_of(f"experiments.{NAME}", records), result_rows(records)
    write_csv(folder / "pool_selection.csv", rows, origin)
    write_figure(folder / "pool_selection.png", pool_figure(rows), origin)
    page = [f"# Choice from a pool ({folder.name})", _READING, markdown_table(mean_rows(records))]
    gains = gain_rows(records)
    page += [_GAINS, markdown_table(gains)] if gains else []
    page.append("![PSNR over views](pool_selection.png)")
    write_markdown(folder / "pool_selection.md", page, origin)
    print(f"results  {folder}")
    return folder


_READING = (
    "PSNR over the test views [dB]: mean with its 95 % interval over views and seeds, 5th "
    "percentile, and the share of views under 20 dB; SSIM. Every scene weighs the same. `cover` "
    "has unexplored cells added (1000 U_G / cells, as in Active-GS), without which it cannot "
    "explore."
)

_GAINS = "What `ours` has over the others on the same test views, PSNR [dB] with 95 % intervals."


def _records(options: Options) -> Iterator[dict[str, Any]]:
    size, commit = SIZES[options.size], source_commit()
    options.work.mkdir(parents=True, exist_ok=True)
    for scene in size.scenes:
        for seed in size.seeds:
            for policy in options.policies:
                begin = time.perf_counter()
                choice = Choice(policy, scene, seed, size, options.known_cells, commit)
                yield _kept_or_made(options.work, choice)
                print(f"{choice.file_name} {time.perf_counter() - begin:.0f} s", flush=True)


def _kept_or_made(work: Path, choice: Choice) -> dict[str, Any]:
    asked = json.loads(json.dumps(dataclasses.asdict(choice)))
    path = work / choice.file_name
    if path.exists():
        kept = json.loads(path.read_text())
        if kept["flight"] == asked:
            return kept
    record = {"flight": asked, "machine": machine()} | make(choice, work / "test_views")
    write_atomic(path, json.dumps(record).encode())
    return record


def make(choice: Choice, test_views: Path) -> dict[str, Any]:
    """Chooses views, then trains and evaluates at every snapshot."""
    size, seed = choice.size, choice.seed
    camera = Camera.from_fov(size.resolution, size.resolution)
    simulator = open_scene(choice.scene, camera=camera, seed=seed)
    truth = GroundTruth(simulator)
    poses = pool_of(truth, size.pool, key=jax.random.key(seed))
    chosen, frames = choose(
        choice.policy,
        simulator,
        poses,
        size.first,
        size.snapshots[-1],
        seed,
        known_cells=choice.known_cells,
    )
    view_set = load_view_set(test_views, truth, max_views=size.test_views)
    tests = load_views(render_view_set(truth, view_set, size.resolution), size.train_resolution)
    scores = {str(n): _train_and_evaluate(frames[:n], tests, choice) for n in size.snapshots}
    return {"chosen": chosen, "scores": scores, "test_views_hash": view_set.hash}


def _train_and_evaluate(frames: list[Frame], tests: Views, choice: Choice) -> dict[str, Any]:
    """Metrics of a model that is trained from scratch on the frames."""
    size = choice.size
    config = TrainConfig(
        iterations=size.iterations,
        num_gaussians=size.gaussians,
        capacity=2 * size.gaussians,
        seed=choice.seed,
    )
    scene = train.fit(load_views(frames, size.train_resolution), config).scene
    rows = evaluate(scene, tests, config.raster).rows
    found = {s.metric.name: s for s in summarize(rows)}
    psnr = found["psnr"]
    return {
        "psnr": psnr.mean,
        "psnr_p5": psnr.percentile_5,
        "poor_share": psnr.poor_share or 0.0,
        "ssim": found["ssim"].mean,
        "psnr_by_view": [row.psnr for row in rows],
    }


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
