"""Runs cells as an array job of a Slurm cluster, through submitit.

A job that is pre-empted or runs out of time is put back into the queue by submitit and goes on
with its cell: all that is complete lies in the benchmark's folder, which every node must see.
"""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from r3jax.benchmark.cells import Cell
from r3jax.benchmark.engines.events import Event, Report
from r3jax.benchmark.engines.local import in_words

_TIMEOUT = 240
"""Minutes that a job asks for, unless the user says otherwise."""

_MAX_TIMEOUTS = 100
"""A job goes back into the queue so many times: each time it gets further."""


class CellJob:
    """What runs on a node."""

    def __call__(self, cell: Cell, root: Path) -> str:
        """Does what is left of a cell; why it failed, or nothing."""
        from r3jax.benchmark.run_cell import run_cell

        try:
            run_cell(cell, root)
        except Exception as error:
            return in_words(error)
        return ""

    def checkpoint(self, cell: Cell, root: Path) -> Any:
        """What goes back into the queue: the same, since the folder knows how far it is."""
        return _submitit().helpers.DelayedSubmission(self, cell, root)


def run_on_cluster(
    cells: Sequence[Cell],
    root: Path,
    report: Report,
    *,
    jobs: int = 1,
    parameters: dict[str, Any] | None = None,
    cluster: str | None = "slurm",
    poll_every: float = 5.0,
) -> None:
    """Submits an array job with one task per cell, and waits for all of them.

    Args:
        cells: what to do.
        root: folder of the benchmark, at the same path on every node.
        report: told what happens.
        jobs: tasks at a time.
        parameters: of `submitit.AutoExecutor.update_parameters`: `timeout_min`,
            `slurm_partition`, `gpus_per_node`, ...
        cluster: where submitit submits: `slurm`; `local` needs no cluster.
        poll_every: seconds between two looks at the jobs.

    Raises:
        ImportError: submitit is not installed.
        KeyboardInterrupt: Ctrl-C; the jobs go on, and another `r3jax benchmark` with the same
            arguments collects what they have done.
    """
    submitit = _submitit()
    root = Path(root).resolve()
    executor = submitit.AutoExecutor(
        folder=root / "slurm", cluster=cluster, slurm_max_num_timeout=_MAX_TIMEOUTS
    )
    shared = {"name": "r3jax", "timeout_min": _TIMEOUT, "slurm_array_parallelism": jobs}
    executor.update_parameters(**shared | (parameters or {}))
    submitted = executor.map_array(CellJob(), cells, [root] * len(cells))
    waiting = list(zip(cells, submitted, strict=True))
    for cell, job in waiting:
        report(Event(cell, "started", f"job {job.job_id}"))
    while waiting:
        still = []
        for cell, job in waiting:
            if job.done():
                report(_end_of(cell, job))
            else:
                still.append((cell, job))
        waiting = still
        if waiting:
            time.sleep(poll_every)


def _end_of(cell: Cell, job: Any) -> Event:
    error = job.exception()  # of the job itself: killed, out of time too often, ...
    reason = job.result() if error is None else in_words(error)
    return Event(cell, "failed", f"job {job.job_id}: {reason}") if reason else Event(cell, "done")


def _submitit() -> Any:
    try:
        import submitit
        import submitit.helpers
    except ImportError as error:
        raise ImportError(
            "--engine slurm needs the package submitit: pip install 'r3jax[slurm]'"
        ) from error
    return submitit
