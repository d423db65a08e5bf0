"""Writes a static page of a benchmark's records: tables to download, curves, and worst views."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure

from r3jax.apps.benchmark.cells import snapshot_slug
from r3jax.apps.benchmark.figures import curve_figure, curves_of, response_figures
from r3jax.apps.benchmark.record import CELLS, read_records, write_records
from r3jax.apps.benchmark.reference_images import path_of_images, read_reference_images
from r3jax.apps.benchmark.table_formats import to_csv, to_latex, to_markdown
from r3jax.apps.benchmark.tables import by_scene_table, headed_groups, tables_of_group
from r3jax.errors import InputError
from r3jax.evaluation.comparison import Cell, methods_of, view_values, with_short_names
from r3jax.files import check_own, make_folder, own_folder, write_atomic
from r3jax.plots import page
from r3jax.plots.style import to_png
from r3jax.runs.writer import encode_png
from r3jax.splatting.ply import read_scene
from r3jax.splatting.render import render


def write_site(root: Path, folder: Path, reference: str | None = None) -> Path:
    """Writes the page, and beside it the images, the records and the tables.

    Args:
        root: folder of the benchmark.
        folder: a new one, or that of an earlier page, which is replaced.
        reference: method that the others are compared with; see `tables.reference_in`.

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
        raise InputError(f"{root} holds no records of explorations: run the benchmark first")
    own_folder(path.parent, "site")
    make_folder(path.parent / "pictures")
    groups: list[dict[str, Any]] = []
    for number, (heading, group) in enumerate(headed_groups(records)):
        quality, costs = tables_of_group(group, heading, reference, with_intervals=True)
        figures = {f"response-{number}-{k}": f for k, f in response_figures(group).items()}
        groups.append(
            {
                "tables": [quality, costs],
                "latex": to_latex(quality) + "\n" + to_latex(costs),
                "markdown": to_markdown(quality) + "\n" + to_markdown(costs),
                "figures": [_store(path.parent, name, figure) for name, figure in figures.items()],
                "views": _worst_views(root, group, path.parent),
            }
        )
    curves = [
        _store(path.parent, f"curve-{n}", curve_figure(group, x))
        for n, (x, group) in enumerate(curves_of(records))
    ]
    write_records(path.parent / CELLS, records)
    write_atomic(path.parent / "table.csv", to_csv(by_scene_table(records, reference)).encode())
    text = page.render(
        "apps/benchmark/site.html",
        kind="benchmark",
        title="r3jax benchmark",
        lead=[],
        cards={},
        groups=groups,
        curves=curves,
        downloads={CELLS: "all records, a JSON object a line", "table.csv": "all tables as CSV"},
    )
    write_atomic(path, text.encode())
    return path


def _store(folder: Path, name: str, figure: Figure) -> str:
    """Writes a figure, and returns its path from the page."""
    path = f"pictures/{name}.png"
    write_atomic(folder / path, to_png(figure))
    return path


def _worst_views(root: Path, group: Sequence[Cell], folder: Path) -> list[dict[str, str]]:
    """Writes the worst test view of each method in each scene, by its first seed."""
    found: dict[tuple[str, str], dict[str, str]] = {}
    pairs = zip(group, with_short_names(group), strict=True)
    for record, short in sorted(pairs, key=lambda pair: (pair[0]["scene"], pair[0]["seed"])):
        (method,), scene = methods_of([short]), short["scene"]
        values = view_values(record, "psnr")
        if values is None or np.isnan(values).all() or (scene, method) in found:
            continue
        worst = int(np.nanargmin(values))
        text = f"{method}, {scene}, seed {record['seed']}: view {worst}, {values[worst]:.1f} dB"
        name = f"{Path(record['run']).parent.name}-{snapshot_slug(record['snapshot'])}.png"
        try:
            write_atomic(folder / "pictures" / name, encode_png(_side_by_side(root, record, worst)))
        except (OSError, ValueError):  # models and test views may be deleted to save room
            name = ""
        found[scene, method] = {"text": text, "picture": f"pictures/{name}" if name else ""}
    return list(found.values())


def _side_by_side(root: Path, record: dict[str, Any] | Cell, view: int) -> np.ndarray:
    """Returns a test view and the model's render of it, [H, 2 W, 3] uint8.

    Raises:
        OSError: one of them is missing.
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
