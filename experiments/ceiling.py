"""How much better could views be chosen? Greedy choice with the ground truth of trained models.

    python -m experiments.ceiling --scenes flat office

A pool of views in free space is on offer. The `oracle` chooses from it by what a planner cannot
know: every step it trains a quick model with each of some candidates, drawn again (stochastic
greedy, Mirzasoleiman et al., AAAI 2015), and keeps the one whose model renders half of the test
views best. The other half judges all choosers, by longer trainings on the same number of views.

    oracle     stochastic greedy on the PSNR of quickly trained models
    known map  `r3jax.select_frames`: greedy on the mean renderability of the pool, map known
    r3-pano    the planner, which explores the scene and chooses its own views
    farthest   farthest-point sampling of positions and directions
    random     by the seed

What stands in `records.jsonl` of `--out` is not done again; an oracle's steps are kept, too.
"""

import dataclasses
import functools
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro

from experiments.pages.artifacts import joint_origin, markdown_table, write_markdown
from experiments.select import Cell, trained
from r3jax.apps.benchmark.record import machine, source_commit
from r3jax.apps.select.select import select_frames
from r3jax.errors import InputError
from r3jax.evaluation.comparison import paired_difference
from r3jax.evaluation.evaluate import evaluate
from r3jax.evaluation.test_views import compute_view_set, render_view_set
from r3jax.files import append_line, make_folder
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera, pose_along
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.planning.candidates import spread
from r3jax.planning.planner import decide, observe, start
from r3jax.simulators.base import Simulator
from r3jax.simulators.free_space import GroundTruth
from r3jax.simulators.scenes.registry import open_scene
from r3jax.splatting.views import Views, load_views

_SPACING, _MARGIN = (0.4, 0.4, 0.4), 0.3
"""Of the places of the pool [m]."""

_SEEN = 0.9
"""Least share of a view of the pool that shows a surface."""

_QUICK = Cell("", "", 1.0, 0, 250, 96)
"""The oracle's trainings."""

_QUICK_GAUSSIANS, _GAUSSIANS = 3_000, 6_000


@dataclasses.dataclass(frozen=True)
class Options:
    """Compares planners with a choice that knows the truth."""

    scenes: tuple[str, ...] = ("flat", "office")

    views: int = 30
    """That each chooser may take."""

    pool: int = 160
    """Views on offer."""

    drawn: int = 16
    """Candidates of each step of the oracle."""

    seeds: tuple[int, ...] = (0, 1, 2)
    """Of the judging trainings; the random choice has its own for each."""

    iterations: int = 3000

    resolution: int = 128
    """Width and height of the images [px]."""

    only_table: bool = False
    """Train nothing: write the table of the records that are there."""

    out: Path = Path("experiments/results/ceiling")


@dataclasses.dataclass(frozen=True)
class Offer:
    """What a scene has on offer, and what judges."""

    world: Simulator
    truth: GroundTruth
    frames: tuple[Frame, ...]
    """The pool."""

    tests: tuple[Frame, ...]

    guiding: np.ndarray
    """Test views that the oracle knows; whole places."""

    judging: np.ndarray


def offer(scene: str, options: Options) -> Offer:
    """Renders the pool and the test views of a scene."""
    camera = Camera.from_fov(options.resolution, options.resolution, 60.0)
    world = open_scene(scene, camera=camera)
    truth, rng = GroundTruth(world), np.random.default_rng(0)
    places = truth.free_positions(_SPACING, _MARGIN)
    looks = fibonacci_lattice(64)
    looks = looks[np.abs(looks[:, 2]) < 0.8]
    draw = lambda values: values[rng.integers(len(values), size=8 * options.pool)]
    poses = np.stack(
        [np.asarray(pose_along(*pair)) for pair in zip(draw(places), draw(looks), strict=True)]
    )
    poses = poses[truth.seen_share(poses) >= _SEEN][: options.pool]
    tests = tuple(render_view_set(truth, compute_view_set(truth, max_views=120), camera.width))
    place = np.unique([np.asarray(f.position) for f in tests], axis=0, return_inverse=True)[1]
    return Offer(world, truth, tuple(truth.frames(poses, camera)), tests,
                 np.flatnonzero(place % 2 == 0), np.flatnonzero(place % 2))  # fmt: skip


def by_oracle(given: Offer, options: Options, path: Path) -> Iterator[Frame]:
    """Chooses by the PSNR of quickly trained models; each step is appended to `path`."""
    pool = load_views(given.frames, _QUICK.resolution)
    guiding = load_views([given.tests[i] for i in given.guiding], _QUICK.resolution)
    lines = path.read_text().splitlines() if path.exists() else []
    chosen: list[int] = [json.loads(line)["chosen"] for line in lines]
    while len(chosen) < options.views:
        rng = np.random.default_rng((1, len(chosen)))
        left = np.setdiff1d(np.arange(len(pool)), chosen)
        found = {
            int(i): _psnr(pool.take(np.array([*chosen, i])), guiding)
            for i in rng.choice(left, min(options.drawn, len(left)), replace=False)
        }
        chosen.append(max(found, key=lambda i: found[i]))
        append_line(path, json.dumps({"chosen": chosen[-1], "psnr": found}))
    return (given.frames[i] for i in chosen)


def _psnr(views: Views, tests: Views) -> float:
    model = trained(views, _QUICK, _QUICK_GAUSSIANS)
    return round(float(np.mean([row.psnr for row in evaluate(model, tests).rows])), 4)


def by_planner(given: Offer, options: Options) -> Iterator[Frame]:
    """Explores with `r3-pano`, from the scene's start."""
    world = given.world
    planner = start(world.camera, world.bounds, "r3-pano", starts=[world.start_pose])
    poses, key = [np.asarray(world.start_pose)], jax.random.key(0)
    while len(poses) < options.views:
        planner = observe(planner, world.render(poses[-1]))
        decision, planner, _ = decide(planner, poses[-1], jax.random.fold_in(key, len(poses)))
        if decision is None:
            raise InputError(f"{given.truth.scene}: no candidate after {len(poses)} views")
        poses.append(np.asarray(decision.T_world_camera))
    # Rendered as the pool is: depth without a limit of range.
    return given.truth.frames(np.stack(poses), world.camera)


def by_known_map(given: Offer, options: Options) -> Iterator[Frame]:
    """Chooses greedily by the mean renderability of the pool."""
    return (given.frames[i] for i in select_frames(given.frames, options.views).order)


def by_distance(given: Offer, options: Options) -> Iterator[Frame]:
    """Chooses the farthest poses; a meter counts as a radian."""
    poses = np.stack([np.asarray(frame.T_world_camera) for frame in given.frames])
    places = np.concatenate([poses[:, :3, 3], poses[:, :3, 2]], axis=1)
    return (given.frames[i] for i in spread(places, options.views))


def by_chance(given: Offer, options: Options, seed: int) -> Iterator[Frame]:
    """Draws from the pool."""
    order = np.random.default_rng(seed).permutation(len(given.frames))
    return (given.frames[i] for i in order[: options.views])


def run(options: Options) -> list[dict[str, Any]]:
    """Runs what is left, and returns all records."""
    path = options.out / "records.jsonl"
    done = read_records(path)
    keys = {(r["scene"], r["chooser"], r["seed"]) for r in done}
    make_folder(options.out)
    for scene in options.scenes:
        given = functools.cache(lambda scene=scene: offer(scene, options))
        choosers = _choosers(given, options, options.out / f"oracle_{scene}.jsonl")
        for seed in options.seeds:
            for name, choose in choosers.items():
                if (scene, name, seed) not in keys:
                    record: dict[str, Any] = {"scene": scene, "chooser": name, "seed": seed}
                    record |= judged(tuple(choose(seed)), given(), seed, options)
                    append_line(path, json.dumps(record))
                    print(f"{scene}, {name}, seed {seed}: {np.mean(record['psnr']):.2f} dB",
                          flush=True)  # fmt: skip
    return read_records(path)


def _choosers(
    given: Callable[[], Offer], options: Options, path: Path
) -> dict[str, Callable[[int], Iterator[Frame]]]:
    return {
        "known map": lambda seed: by_known_map(given(), options),
        "r3-pano": lambda seed: by_planner(given(), options),
        "farthest": lambda seed: by_distance(given(), options),
        "random": lambda seed: by_chance(given(), options, seed),
        "oracle": lambda seed: by_oracle(given(), options, path),
    }


def judged(frames: tuple[Frame, ...], given: Offer, seed: int, options: Options) -> dict[str, Any]:
    """Trains on the frames, and measures the test views that no chooser knows."""
    cell = Cell("", "", 1.0, seed, options.iterations, options.resolution)
    model = trained(load_views(frames, options.resolution), cell, _GAUSSIANS)
    tests = load_views([given.tests[i] for i in given.judging], options.resolution)
    rows = evaluate(model, tests).rows
    return {
        "psnr": [round(row.psnr, 4) for row in rows],
        "coverage": [round(row.coverage, 4) for row in rows],
        "poses": [np.round(np.asarray(f.T_world_camera), 4).tolist() for f in frames],
        **{k: v for k, v in dataclasses.asdict(options).items() if k in _TERMS},
        "commit": source_commit(),
        "machine": machine(),
    }


_TERMS = ("views", "pool", "drawn", "iterations", "resolution")


def read_records(path: Path) -> list[dict[str, Any]]:
    """Reads what is done."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def table(records: list[dict[str, Any]], scene: str) -> list[dict[str, Any]]:
    """One row for each chooser, the best first: mean over seeds, and the lead over `r3-pano`."""
    at = [r for r in records if r["scene"] == scene]
    scores = {
        name: np.array([r["psnr"] for r in at if r["chooser"] == name])
        for name in dict.fromkeys(r["chooser"] for r in at)
    }
    rows: list[dict[str, Any]] = []
    for name, found in sorted(scores.items(), key=lambda item: -item[1].mean()):
        worst = np.sort(found, axis=1)[:, : max(1, found.shape[1] // 10)]
        row = {"chooser": name, "PSNR [dB]": f"{found.mean():.2f}",
               "worst tenth": f"{worst.mean():.2f}", "minus r3-pano": ""}  # fmt: skip
        if name != "r3-pano" and found.shape == scores["r3-pano"].shape:
            lead = paired_difference({scene: found}, {scene: scores["r3-pano"]})
            row["minus r3-pano"] = f"{lead.value:+.2f} [{lead.low:+.2f}, {lead.high:+.2f}]"
        rows.append(row)
    return rows


def main(options: Options) -> None:
    """Runs and writes the tables."""
    records = read_records(options.out / "records.jsonl") if options.only_table else run(options)
    pages: list[str] = []
    for scene in dict.fromkeys(r["scene"] for r in records):
        pages += [f"{scene}:", markdown_table(table(records, scene))]
    write_markdown(
        options.out / "tables.md",
        pages,
        joint_origin(
            "experiments.ceiling", [r["machine"] for r in records], [r["commit"] for r in records]
        ),
    )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
