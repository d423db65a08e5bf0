"""A static page of all records of a benchmark: tables with intervals, and the worst views."""

import html
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from string import Template
from typing import Any

import jax
import numpy as np

from r3jax.apps.benchmark.conditions import snapshot_slug
from r3jax.apps.benchmark.groups import headed_groups
from r3jax.apps.benchmark.record import machine, read_records
from r3jax.apps.benchmark.reference_images import path_of_images, read_reference_images
from r3jax.apps.benchmark.tables import full_title, notes
from r3jax.evaluation.comparison import (
    Cell,
    methods_of,
    scenes_of,
    scores_by_method,
    view_values,
    with_short_names,
)
from r3jax.evaluation.scores import METRICS, Metric
from r3jax.evaluation.statistics import Scores, mean_over_scenes, paired_difference
from r3jax.files import check_own, make_folder, own_folder, write_atomic
from r3jax.runs.writer import encode_png
from r3jax.splatting.ply import read_scene
from r3jax.splatting.render import render

PAPER_LEAD = ("ours-pano", "active-gs", "views:300", 2.9, "arXiv 2601.07484")
"""What the paper reports of one method minus another at a budget, mean PSNR [dB], and its source;
docs/results/views.md has it beside ours."""

_GENERATOR = '<meta name="generator" content="r3jax benchmark">'

_PAGE = Template(
    """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
$generator
<title>r3jax benchmark</title>
<style>
 body { font: 15px/1.5 system-ui, sans-serif; color: #1f2937; max-width: 1060px; margin: 24px auto;
   padding: 0 20px }
 table { border-collapse: collapse; font-size: 14px; margin: 8px 0 }
 th, td { text-align: left; padding: 4px 14px 4px 0; border-bottom: 1px solid #e5e7eb }
 td + td, th + th { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap }
 p.note { color: #6b7280; font-size: 13.5px; margin: 4px 0 }
 figure { display: inline-block; margin: 8px 12px 8px 0 } figcaption { font-size: 13px }
 img { image-rendering: pixelated; height: 160px; display: block }
</style></head><body>
<h1>r3jax benchmark</h1>
$body
</body></html>
"""
)


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
    page = Path(folder) / "index.html"
    check_own(page.parent, "site")
    records = read_records(root)
    if not records:
        raise ValueError(
            f"{root} holds no records of explorations: run the benchmark first (those of --photos "
            "are no part of the page)"
        )
    own_folder(page.parent, "site")
    make_folder(page.parent / "pictures")
    parts = [_speed(on_stage)]
    for heading, group in headed_groups(records):
        parts += [f"<h2>{_text(heading)}</h2>", *_tables(group), *_papers(group)]
        parts += _worst_views(root, group, page.parent, on_stage)
    write_atomic(page, _PAGE.substitute(generator=_GENERATOR, body="\n".join(parts)).encode())
    return page


def _text(value: object) -> str:
    return html.escape(str(value))


def _row(cells: Sequence[object], tag: str = "td") -> str:
    return "<tr>" + "".join(f"<{tag}>{_text(cell)}</{tag}>" for cell in cells) + "</tr>"


def _tables(group: Sequence[Cell]) -> list[str]:
    """A table for each metric: methods x scenes and their mean, with 95 % intervals."""
    told, group = notes(group), with_short_names(group)
    parts: list[str] = []
    for metric in METRICS:
        scores = scores_by_method(group, metric.name)
        if not scores:
            continue
        scenes = scenes_of(group)
        rows = [_row([full_title(metric), *scenes, "mean"], "th")]
        for method in methods_of(group):
            found = scores.get(method, {})
            entries = [_estimate({s: found[s]} if s in found else {}, metric) for s in scenes]
            whole = _estimate(found if set(found) == set(scenes) else {}, metric)
            rows.append(_row([method, *entries, whole]))
        parts.append(f"<table>{''.join(rows)}</table>")
    return [*parts, *(f'<p class="note">{_text(sentence)}</p>' for sentence in told)]


def _estimate(scores: Scores, metric: Metric) -> str:
    """A mean over scenes with its interval; a dash where there is none."""
    if not scores:
        return "–"
    found = mean_over_scenes(scores)
    value, low, high = (f"{x:.{metric.decimals}f}" for x in (found.value, found.low, found.high))
    return f"{value} [{low}, {high}]"


def _papers(group: Sequence[Cell]) -> list[str]:
    """The paper's lead of a method beside ours, where both methods are here in the same scenes."""
    first, second, budget, lead, source = PAPER_LEAD
    scores = scores_by_method(with_short_names(group), "psnr")
    try:
        ours = paired_difference(scores[first], scores[second])
    except (KeyError, ValueError):  # not both of them, or not with the same scenes and seeds
        return []
    rows = [
        _row([f"{first} minus {second}, PSNR [dB]", "", "budget"], "th"),
        _row(
            ["here", f"{ours.value:+.2f} [{ours.low:+.2f}, {ours.high:+.2f}]", group[0]["snapshot"]]
        ),
        _row([source, f"{lead:+.1f}", budget]),
    ]
    return [
        f"<table>{''.join(rows)}</table>",
        '<p class="note">Other scenes, budget and training: see docs/results/views.md.</p>',
    ]


def _worst_views(
    root: Path, group: Sequence[Cell], folder: Path, on_stage: Callable[[str], None]
) -> list[str]:
    """The worst test view of each method in each scene, by its first seed: image beside model."""
    parts: list[str] = []
    done: set[tuple[str, str]] = set()
    named = with_short_names(group)
    for record, short in sorted(
        zip(group, named, strict=True), key=lambda pair: (pair[0]["scene"], pair[0]["seed"])
    ):
        (method,) = methods_of([short])
        values = view_values(record, "psnr")
        if values is None or np.isnan(values).all() or (short["scene"], method) in done:
            continue
        done.add((short["scene"], method))
        worst = int(np.nanargmin(values))
        on_stage(f"drawing the worst view of {method} in {short['scene']}")
        told = f"{method}, {short['scene']}, seed {record['seed']}: view {worst}, "
        told += f"{values[worst]:.1f} dB"
        try:
            picture = _side_by_side(root, record, worst)
        except (OSError, ValueError):  # models and test views may be deleted to save room
            parts.append(f'<p class="note">{_text(told)}; its model or image is gone</p>')
            continue
        name = f"{Path(record['run']).parent.name}-{snapshot_slug(record['snapshot'])}.png"
        write_atomic(folder / "pictures" / name, encode_png(picture))
        parts.append(
            f'<figure><img src="pictures/{_text(name)}" alt="test view, and the model\'s">'
            f"<figcaption>{_text(told)}</figcaption></figure>"
        )
    return [
        *(["<h3>The worst views: as it is, and as the model has it</h3>"] if parts else []),
        *parts,
    ]


def _side_by_side(root: Path, record: dict[str, Any] | Cell, view: int) -> np.ndarray:
    """A test view and the model's image of it, [H, 2 W, 3] uint8.

    Raises:
        OSError: one of them is not there.
        ValueError: one of them is damaged.
    """
    path = path_of_images(
        root,
        record["scene_hash"],
        record["test_views"]["hash"],
        (record["resolution"], record["sensing"]["fov"], record["test_views"]["resolution"]),
    )
    views = read_reference_images(path).views
    slug = snapshot_slug(record["snapshot"])
    scene = read_scene(root / record["run"] / "models" / slug / "scene.ply")
    camera = jax.tree.map(lambda x: x[view], views.cameras)
    rgb = np.asarray(render(scene, camera, views.T_world_camera[view]).rgb)
    drawn = np.rint(np.clip(rgb, 0.0, 1.0) * np.float32(255.0)).astype(np.uint8)
    return np.concatenate([np.asarray(views.rgb[view]), drawn], axis=1)


def _speed(on_stage: Callable[[str], None]) -> str:
    """How fast this machine is, so that seconds of the wall clock can be told from luck."""
    on_stage("timing a fixed computation")
    found = ", ".join(f"{name} {1000 * seconds:.0f} ms" for name, seconds in probe().items())
    return f'<p class="note">This page was made on {_text(machine())}: {_text(found)}.</p>'


def probe(repeats: int = 5) -> dict[str, float]:
    """Times two fixed computations of NumPy, the best of some repeats each [s]."""
    rng = np.random.default_rng(0)
    numbers, matrix = rng.random(1 << 19), rng.random((512, 512), dtype=np.float32)
    parts: dict[str, Callable[[], object]] = {
        "sorting 2^19 numbers": lambda: np.sort(numbers),
        "a product of 512 x 512 matrices": lambda: matrix @ matrix,
    }
    return {name: min(_seconds(part) for _ in range(repeats)) for name, part in parts.items()}


def _seconds(part: Callable[[], object]) -> float:
    begin = time.perf_counter()
    part()
    return time.perf_counter() - begin
