"""Could half of the views do? Half of what a run took, chosen when all of it was known.

    python -m experiments.half --size small --scenes flat office

Looking ahead is to reach with half of the views what `ours-pano` reaches with all of them. Here the
run is over, and its map and the places of the test views are known. Half of its views are chosen
with all that, and a model is trained on them. How far it stays behind the model of all views says
how much of the gap is in the number of views and not in their choice; it is no bound, as other
views than those of the run might do better.

The cells are those of `experiments.beyond`. What was trained once is kept.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import tyro

from experiments.artefacts import Origin, joint_origin, markdown_table, write_csv, write_markdown
from experiments.replica_dense import REFERENCE
from experiments.suite import Options, Records, request_of, run_requests
from r3jax.benchmark.cells import Cell, paths_of
from r3jax.benchmark.judging import load_judging_views
from r3jax.benchmark.record import machine, source_commit
from r3jax.evaluation.equal_terms import (
    scenes_of,
    scores_by_method,
    snapshots_of,
    with_short_names,
)
from r3jax.evaluation.judge import judge
from r3jax.evaluation.statistics import mean_over_scenes, paired_difference
from r3jax.exploration.replay import rebuild
from r3jax.files import write_atomic
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.candidates import spread
from r3jax.scoring.batch import demand_from, score_views_near
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.demand import cover_after
from r3jax.scoring.near import near
from r3jax.splatting import train
from r3jax.splatting.views import load_views
from r3jax.trace.reader import read_run

NAME = "half"

STANDPOINTS = 32
"""Places of test views for which views are chosen in hindsight."""

EVERY_SECOND, IN_HINDSIGHT = "every second", "in hindsight"


def main(options: Options) -> Path:
    """Trains on half of the views of every run, writes the page, and returns its folder."""
    request = replace(request_of(options, "views"), policies=(REFERENCE,))
    root, cells, records = run_requests(options, "views", [request])
    halves = [half for cell in cells for half in halves_of(cell, root)]
    made = [*records, *halves]
    source = joint_origin(
        f"experiments.{NAME}", [m["machine"] for m in made], [m["commit"] for m in made]
    )
    folder = options.out / NAME / options.size
    write_page(folder, records, halves, source)
    print(f"results  {folder}")
    return folder


def halves_of(cell: Cell, root: Path) -> list[dict[str, Any]]:
    """What models of half of a cell's views are worth; kept where it was found before.

    In the form of the referee's records, with the choice in the policy's place.
    """
    path = root / NAME / f"{cell.name}.json"
    if path.exists():
        return json.loads(path.read_text())
    run, judging = read_run(paths_of(root, cell).run), load_judging_views(root, cell)
    chosen = {
        EVERY_SECOND: list(range(0, len(run.rows), 2)),
        IN_HINDSIGHT: chosen_in_hindsight(
            rebuild([run]),
            run.camera,
            np.stack([np.asarray(row.pose) for row in run.rows]),
            judging.poses[:, :3, 3],
            len(run.rows) // 2,
            ScoringConfig(max_range=cell.conditions.max_range),
        ),
    }
    config = cell.conditions.train_config(cell.seed)
    found: list[dict[str, Any]] = []
    for choice, steps in chosen.items():
        views = load_views(map(run.frame, steps), cell.conditions.train_resolution)
        rows = judge(train.fit(views, config).scene, judging.views, config.raster).rows
        found.append(
            {
                "policy": choice,
                "settings": {},
                "scene": cell.scene,
                "seed": cell.seed,
                "steps": steps,
                "views": {"psnr": [row.psnr for row in rows]},
                "machine": machine(),
                "commit": source_commit(),
            }
        )
        mean = np.mean([row.psnr for row in rows])
        print(f"{cell.name}: {choice} {mean:.2f} dB", flush=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, json.dumps(found).encode())
    return found


def chosen_in_hindsight(
    known: tuple[MapState, OccupancyGrid],
    camera: Camera,
    poses: np.ndarray,
    places: np.ndarray,
    num: int,
    config: ScoringConfig,
) -> list[int]:
    """Views, chosen greedily for what would be asked for from some places.

    Geometry and colors are those of the map, seen directions and resolutions forgotten; each time
    the view is taken that adds most (`scoring.demand`) to those before it.

    Args:
        known: map and grid at the end.
        camera: of the views.
        poses: to choose from, [n, 4, 4].
        places: who asks, [p, 3] [m]; of many, `STANDPOINTS` that lie apart.
        num: how many views.
        config: range and visibility.

    Returns:
        Their numbers, in the order of the choice.
    """
    state, grid = known
    forgotten = eqx.tree_at(lambda m: (m.visited, m.resolution), state, replace_fn=jnp.zeros_like)
    T = jnp.asarray(poses, jnp.float32)
    asking = jnp.asarray(places[spread(places, STANDPOINTS)], jnp.float32)
    voxels, cells, _ = near(forgotten, grid, jnp.concatenate([T[:, :3, 3], asking]), config)
    demand = demand_from(voxels, camera, asking, config)
    after = jax.jit(cover_after)
    chosen: list[int] = []
    for _ in range(num):
        gain = score_views_near(voxels, cells, camera, T, config, demand).rendering
        left = np.where(np.isin(np.arange(len(T)), chosen), -np.inf, np.asarray(gain))
        chosen.append(int(left.argmax()))
        demand = after(voxels, demand, camera, T[chosen[-1]], config)
    return chosen


def write_page(folder: Path, records: Records, halves: Records, source: Origin) -> None:
    """Writes the table.

    Args:
        folder: where to.
        records: of the whole runs, two snapshots at least.
        halves: of `halves_of`, for the same scenes and seeds.
        source: command, machine, commit.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rows = table_rows(records, halves)
    write_csv(folder / f"{NAME}.csv", rows, source)
    page = [
        "# Half of the views, chosen when all is known",
        f"PSNR [dB] of models of the views of {REFERENCE}, and what they lack against the model of "
        "all views on the same test views, mean over scenes, with its 95 % interval. *First*: what "
        f"it has halfway. *In hindsight*: greedily, for {STANDPOINTS} places of the test views.",
        markdown_table(rows),
    ]
    write_markdown(folder / f"{NAME}.md", page, source)


def table_rows(records: Records, halves: Records) -> list[dict[str, Any]]:
    """A line per choice: the mean PSNR of every scene, and the difference to all views."""
    named = with_short_names([*records, *halves])
    records, halves = named[: len(records)], named[len(records) :]
    snapshots = snapshots_of(records)
    scores = {
        name: scores_by_method([r for r in records if r["snapshot"] == snapshot], "psnr")[REFERENCE]
        for name, snapshot in (("all", snapshots[-1]), (f"first, {snapshots[0]}", snapshots[0]))
    } | scores_by_method(halves, "psnr")
    scenes = scenes_of(records)
    rows: list[dict[str, Any]] = []
    for name, by_scene in scores.items():
        lacks = paired_difference(by_scene, scores["all"])
        rows.append(
            {"views": name}
            | {scene: f"{by_scene[scene].mean():.2f}" for scene in scenes}
            | {"mean": f"{mean_over_scenes(by_scene).value:.2f}"}
            | {"against all": f"{lacks.value:+.2f} [{lacks.low:+.2f}, {lacks.high:+.2f}]"}
        )
    return rows


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
