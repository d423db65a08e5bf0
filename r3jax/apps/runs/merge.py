"""Several runs of one scene as one data set, with the map that saw all of them."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

from r3jax.exploration.replay import check_alike, parts_of, rebuild
from r3jax.files import make_folder
from r3jax.formats.nerfstudio import write_transforms
from r3jax.formats.points import voxel_points, write_points
from r3jax.mapping.state import MapState
from r3jax.trace.checkpoints import map_tables
from r3jax.trace.errors import RunError
from r3jax.trace.header import RunHeader, package_versions
from r3jax.trace.reader import Run, read_run
from r3jax.trace.rows import StepRow, unit_of
from r3jax.trace.writer import RunWriter


def merge_runs(
    runs: list[Run],
    out: Path,
    *,
    overwrite: bool = False,
    on_frame: Callable[[], None] = lambda: None,
) -> MapState:
    """Writes a run that holds the views of several, one run after the other.

    The rows of a later run are numbered on, and its totals (clock, path, angle) added to those
    before; what a row says of the map is of that run's own map. The stored map and grid have
    seen all.

    Args:
        runs: of one scene, mapped on the same terms, with the same camera.
        out: folder of the merged run.
        overwrite: replace the run that is there.
        on_frame: called after every frame that has entered the map.

    Returns:
        The map.

    Raises:
        RunError: the runs do not fit together, cannot be read, or `out` cannot be written.
    """
    _check_apart(runs)
    for run in runs[1:]:
        check_alike(runs[0], run)
        if run.header.camera != runs[0].header.camera:
            raise RunError(
                run.path,
                f"its camera is not that of {runs[0].path}, and a run has one: {run.header.camera} "
                f"instead of {runs[0].header.camera}",
            )
    map_state, grid = rebuild(runs, on_frame=on_frame)
    with RunWriter(out, _header(runs), overwrite=overwrite) as writer:
        last: StepRow | None = None
        for run in runs:
            before = last
            for row in run.rows:
                last = _behind(row, before)
                writer.adopt(last, run, row.step)
        writer.checkpoint(writer.views - 1, map_tables(map_state, grid), wait=True)
        writer.finish("merged", f"the views of {' and '.join(str(run.path) for run in runs)}")
    merged = read_run(out)
    points = out / "exports" / "points.ply"
    make_folder(points.parent)
    write_points(points, *voxel_points(map_state))
    write_transforms(merged, points.relative_to(out).as_posix())
    return map_state


def _check_apart(runs: list[Run]) -> None:
    """Refuses views that would count twice.

    Raises:
        RunError: a run is given twice, under whatever path.
    """
    for number, run in enumerate(runs):
        if any(run.path.samefile(other.path) for other in runs[:number]):
            raise RunError(run.path, "a run is not merged with itself: give two different runs")


def _header(runs: list[Run]) -> RunHeader:
    views = [views for run in runs for views in parts_of(run)]
    unit = unit_of(row for run in runs for row in run.rows)
    return dataclasses.replace(
        runs[0].header,
        budget=f"{unit}:{sum(views)}",
        packages=package_versions(),
        parent={"merged": [str(run.path) for run in runs], "merged_views": views},
    )


def _behind(row: StepRow, before: StepRow | None) -> StepRow:
    """A row of a later run, numbered on behind the last row of the runs before."""
    if before is None:
        return row
    return dataclasses.replace(
        row,
        step=before.step + 1 + row.step,
        seconds=before.seconds + row.seconds,
        metres=before.metres + row.metres,
        radians=before.radians + row.radians,
    )
