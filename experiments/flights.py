"""The poses of a table's flights, kept beside it: anybody can take and judge the frames again."""

import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from r3jax.apps.benchmark.cells import Cell, paths_of
from r3jax.evaluation.comparison import scene_title
from r3jax.formats.submissions import submission_of_run, write_submission
from r3jax.runs.reader import read_run


def keep_flights(
    folder: Path,
    name: str,
    root: Path,
    cells: Mapping[str, Sequence[Cell]],
    kept: Sequence[Path] = (),
) -> None:
    """Writes the poses of every cell, a submission each, under the name of its row.

    Args:
        folder: of the table.
        name: of the table; the poses lie in `<name>_flights`.
        root: folder of the benchmark.
        cells: of each row.
        kept: files that lie beside tables of the same name that were made elsewhere; poses of a
            cell that was not flown here are copied from beside them.

    Raises:
        ValueError: a run is damaged.
        OSError: a file cannot be read or written.
    """
    here, *others = (path / f"{name}_flights" for path in (folder, *(file.parent for file in kept)))
    here.mkdir(parents=True, exist_ok=True)
    for label, own in cells.items():
        for cell in own:
            path, run = here / _file_name(label, cell), paths_of(root, cell).run
            if run.exists():
                flown = submission_of_run(read_run(run))
                write_submission(path, replace(flown, policy=flown.policy | {"name": label}))
                continue
            for there in (other / path.name for other in others):
                if there.exists() and there.resolve() != path.resolve():
                    shutil.copyfile(there, path)


def _file_name(label: str, cell: Cell) -> str:
    row = re.sub("[^0-9a-z.]+", "-", label)
    return f"{row}_{scene_title(cell.scene)}_{cell.seed}.jsonl"
