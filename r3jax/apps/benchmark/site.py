"""Writes a static page of a benchmark's records: tables with intervals, and the worst views."""

import timeit
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from r3jax.apps.benchmark.cells import snapshot_slug
from r3jax.apps.benchmark.record import machine, read_records
from r3jax.apps.benchmark.reference_images import path_of_images, read_reference_images
from r3jax.apps.benchmark.tables import full_title, headed_groups, notes
from r3jax.errors import InputError
from r3jax.evaluation.comparison import (
    Cell,
    methods_of,
    scenes_of,
    scores_by_method,
    view_values,
    with_short_names,
)
from r3jax.evaluation.scores import METRICS, Metric
from r3jax.evaluation.statistics import Estimate, mean_over_scenes, paired_difference
from r3jax.files import check_own, make_folder, own_folder, write_atomic
from r3jax.plots import page
from r3jax.runs.writer import encode_png
from r3jax.splatting.ply import read_scene
from r3jax.splatting.render import render

PAPER_LEAD = ("r3-pano", "active-gs", "views:300", 2.9, "arXiv 2601.07484")
"""What the paper reports of one method minus another at a budget, mean PSNR [dB], and its source;
docs/results/views.md has it beside ours."""


def write_site(
    root: Path, folder: Path, on_stage: Callable[[str], None] = lambda stage: None
) -> Path:
    """Writes the page, and the pictures beside it.

    Args:
        root: folder of the benchmark.
        folder: a new one, or that of an earlier page, which is replaced.
        on_stage: told what happens now.

    Returns:
        The page.

    Raises:
        ValueError: there are no records, one is damaged, or the folder holds something else, of
            which nothing is touched.
        OSError: the disk is full, not writable, ...
    """
    path = Path(folder) / "index.html"
    check_own(path.parent, "site")
    records = read_records(root)
    if not records:
        raise InputError(
            f"{root} holds no records of explorations: run the benchmark first (those of --photos "
            "are no part of the page)"
        )
    own_folder(path.parent, "site")
    make_folder(path.parent / "pictures")
    on_stage("timing a fixed computation")
    timed = ", ".join(f"{name} {1000 * seconds:.0f} ms" for name, seconds in probe().items())
    groups = [
        {
            "heading": heading,
            "tables": _tables(group),
            "notes": notes(group),
            "paper": _paper(group),
            "views": list(_worst_views(root, group, path.parent, on_stage)),
        }
        for heading, group in headed_groups(records)
    ]
    text = page.render(
        "apps/benchmark/site.html",
        kind="benchmark",
        title="r3jax benchmark",
        lead=[],
        cards={},
        machine=f"This page was made on {machine()}: {timed}.",
        groups=groups,
    )
    write_atomic(path, text.encode())
    return path


def _tables(group: Sequence[Cell]) -> list[list[list[str]]]:
    """A table for each metric: methods x scenes and their mean, with 95 % intervals."""
    group = with_short_names(group)
    tables: list[list[list[str]]] = []
    scenes = scenes_of(group)
    for metric in METRICS:
        scores = scores_by_method(group, metric.name)
        if not scores:
            continue
        rows = [[full_title(metric), *scenes, "mean"]]
        for method in methods_of(group):
            found = scores.get(method, {})
            parts = [{s: found[s]} if s in found else {} for s in scenes]
            parts.append(found if set(found) == set(scenes) else {})
            estimates = [mean_over_scenes(part) if part else None for part in parts]
            rows.append([method, *(_estimate(estimate, metric) for estimate in estimates)])
        tables.append(rows)
    return tables


def _estimate(found: Estimate | None, metric: Metric) -> str:
    """A mean with its interval; a dash where there is none."""
    if found is None:
        return "–"
    value, low, high = (f"{x:.{metric.decimals}f}" for x in (found.value, found.low, found.high))
    return f"{value} [{low}, {high}]"


def _paper(group: Sequence[Cell]) -> list[list[str]]:
    """The paper's lead of a method beside ours, where both methods are here in the same scenes."""
    first, second, budget, lead, source = PAPER_LEAD
    scores = scores_by_method(with_short_names(group), "psnr")
    try:
        ours = paired_difference(scores[first], scores[second])
    except (KeyError, ValueError):  # not both of them, or not with the same scenes and seeds
        return []
    here = f"{ours.value:+.2f} [{ours.low:+.2f}, {ours.high:+.2f}]"
    return [
        [f"{first} minus {second}, PSNR [dB]", "", "budget"],
        ["here", here, group[0]["snapshot"]],
        [source, f"{lead:+.1f}", budget],
    ]


def _worst_views(
    root: Path, group: Sequence[Cell], folder: Path, on_stage: Callable[[str], None]
) -> Iterator[dict[str, str]]:
    """The worst test view of each method in each scene, by its first seed: image beside model."""
    done: set[tuple[str, str]] = set()
    pairs = zip(group, with_short_names(group), strict=True)
    for record, short in sorted(pairs, key=lambda pair: (pair[0]["scene"], pair[0]["seed"])):
        (method,), scene = methods_of([short]), short["scene"]
        values = view_values(record, "psnr")
        if values is None or np.isnan(values).all() or (scene, method) in done:
            continue
        done.add((scene, method))
        worst = int(np.nanargmin(values))
        on_stage(f"drawing the worst view of {method} in {scene}")
        text = f"{method}, {scene}, seed {record['seed']}: view {worst}, {values[worst]:.1f} dB"
        try:
            picture = _side_by_side(root, record, worst)
        except (OSError, ValueError):  # models and test views may be deleted to save room
            yield {"text": text, "picture": ""}
            continue
        name = f"{Path(record['run']).parent.name}-{snapshot_slug(record['snapshot'])}.png"
        write_atomic(folder / "pictures" / name, encode_png(picture))
        yield {"text": text, "picture": f"pictures/{name}"}


def _side_by_side(root: Path, record: dict[str, Any] | Cell, view: int) -> np.ndarray:
    """A test view and the model's image of it, [H, 2 W, 3] uint8.

    Raises:
        OSError: one of them is not there.
        ValueError: one of them is damaged.
    """
    sizes = (record["resolution"], record["sensing"]["fov"], record["test_views"]["resolution"])
    path = path_of_images(root, record["scene_hash"], record["test_views"]["hash"], sizes)
    views = read_reference_images(path).views
    slug = snapshot_slug(record["snapshot"])
    scene = read_scene(root / record["run"] / "models" / slug / "scene.ply")
    camera = jax.tree.map(lambda x: x[view], views.cameras)
    rgb = np.asarray(render(scene, camera, views.T_world_camera[view]).rgb)
    drawn = np.rint(np.clip(rgb, 0.0, 1.0) * np.float32(255.0)).astype(np.uint8)
    return np.concatenate([np.asarray(views.rgb[view]), drawn], axis=1)


def probe(repeats: int = 5) -> dict[str, float]:
    """Times two fixed computations of NumPy, the best of some repeats each [s].

    So that seconds of the wall clock can be compared between machines.
    """
    rng = np.random.default_rng(0)
    numbers, matrix = rng.random(1 << 19), rng.random((512, 512), dtype=np.float32)
    parts: dict[str, Callable[[], object]] = {
        "sorting 2^19 numbers": lambda: np.sort(numbers),
        "a product of 512 x 512 matrices": lambda: matrix @ matrix,
    }
    return {
        name: min(timeit.repeat(part, number=1, repeat=repeats)) for name, part in parts.items()
    }
