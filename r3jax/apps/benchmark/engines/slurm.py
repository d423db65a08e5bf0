"""Runs cells as an array job of a Slurm cluster, through submitit.

A job that is preempted or runs out of time is requeued by submitit and resumes its cell. Complete
results are in the benchmark's folder, which must be visible on every node.

submitit polls `sacct` for jobs that have ended, which fails on clusters without an accounting
database: it would wait for a killed job without end. `squeue`, used here, works on all of them.
"""

import itertools
import subprocess
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from r3jax.apps.benchmark.cells import Cell, snapshots_left
from r3jax.apps.benchmark.engines.local import Event, Report, describe_error

_ENDED = {
    "BOOT_FAIL",
    "CANCELLED",
    "COMPLETED",
    "DEADLINE",
    "FAILED",
    "NODE_FAIL",
    "OUT_OF_MEMORY",
    "PREEMPTED",
    "TIMEOUT",
}
"""States of jobs that have ended. All others are temporary, such as that of a requeued job."""

_PATIENCE = 60.0
"""Timeout of a query to the controller; it is repeated later [s]."""


def ended_jobs(job_ids: Iterable[str]) -> dict[str, str]:
    """Queries the Slurm queue for jobs that have ended, with their state and its reason.

    Args:
        job_ids: in submitit's form: `12`, or `12_3` of an array.

    Returns:
        By id. Also empty if the controller does not respond: it may at the next poll.

    Raises:
        OSError: there is no `squeue`.
    """
    job_ids = list(job_ids)
    arrays = sorted({job_id.split("_")[0] for job_id in job_ids})
    command = ["squeue", "--noheader", "--array", "--states=all", "--format=%i|%T|%r"]
    try:
        answer = subprocess.run(
            [*command, f"--jobs={','.join(arrays)}"],
            capture_output=True,
            text=True,
            timeout=_PATIENCE,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return {}
    if answer.returncode and "Invalid job id" not in answer.stderr:
        return {}
    return read_queue(job_ids, answer.stdout)


def read_queue(job_ids: Iterable[str], listing: str) -> dict[str, str]:
    """Finds the jobs that have ended in a listing of the queue, lines `id|state|reason`.

    A job that is not listed ended so long ago that Slurm has dropped it (its MinJobAge).
    """
    listed: dict[str, tuple[str, str]] = {}
    for line in listing.splitlines():
        job_id, state, reason = line.strip().split("|", 2)
        listed[job_id] = (state, reason)
    ended: dict[str, str] = {}
    for job_id in job_ids:
        state, reason = listed.get(job_id, ("no longer in the queue", "None"))
        if state in _ENDED or job_id not in listed:
            ended[job_id] = state if reason == "None" else f"{state} ({reason})"
    return ended


_TIMEOUT = 240
"""Minutes that a job asks for, unless the user says otherwise."""

_MAX_TIMEOUTS = 100
"""How often a job goes back into the queue: each time it gets further."""

_POLLS_PER_QUERY = 6
"""Number of polls of the results per query of the queue, as a controller has many users."""


class CellJob:
    """The task of a node."""

    def __call__(self, cell: Cell, root: Path) -> str:
        """Computes the rest of a cell; returns why it failed, or an empty string."""
        from r3jax.apps.benchmark.run_cell import run_cell

        try:
            run_cell(cell, root)
        except Exception as error:
            return describe_error(error)
        return ""

    def checkpoint(self, cell: Cell, root: Path) -> Any:
        """Returns the job to put back into the queue; it continues from the files in its folder."""
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
        cells: the cells to compute.
        root: folder of the benchmark, at the same path on every node.
        report: called with every event.
        jobs: tasks at a time.
        parameters: arguments of `submitit.AutoExecutor.update_parameters`: `timeout_min`,
            `slurm_partition`, `gpus_per_node`, ...
        cluster: cluster of submitit: `slurm`, or `local`, which needs none.
        poll_every: interval of the polls [s].

    Raises:
        ImportError: submitit is not installed.
        KeyboardInterrupt: Ctrl-C; the jobs continue, and another `r3jax benchmark` with the same
            arguments collects their results.
    """
    submitit = _submitit()
    root = Path(root).resolve()
    executor = submitit.AutoExecutor(
        folder=root / "slurm", cluster=cluster, slurm_max_num_timeout=_MAX_TIMEOUTS
    )
    shared = {"name": "r3jax", "timeout_min": _TIMEOUT, "slurm_array_parallelism": jobs}
    executor.update_parameters(**shared | (parameters or {}))
    submitted = executor.map_array(CellJob(), cells, [root] * len(cells))
    waiting = {job.job_id: (cell, job) for cell, job in zip(cells, submitted, strict=True)}
    for job_id, (cell, _) in waiting.items():
        report(Event(cell, "started", f"job {job_id}"))
    ended = ended_jobs if cluster == "slurm" else partial(_ended_by_submitit, submitted)
    _wait_for(waiting, root, report, ended, poll_every)


def _wait_for(
    waiting: dict[str, tuple[Cell, Any]],
    root: Path,
    report: Report,
    ended: Callable[[Iterable[str]], dict[str, str]],
    poll_every: float,
) -> None:
    """Reports the end of each job in `waiting`: cell and job by the job's id.

    A job with a result has ended. A job that left the queue without a result may have one that a
    network file system does not show yet: it has failed if there is none at the next query.
    """
    before: dict[str, str] = {}
    for poll in itertools.count():
        queries = poll % _POLLS_PER_QUERY == 0
        now = ended(waiting) if queries else {}
        for job_id, (cell, job) in tuple(waiting.items()):
            if job.paths.result_pickle.exists():
                report(_end_of(cell, job))
            elif job_id in before and job_id in now:
                report(_end_without_result(cell, root, job, now[job_id]))
            else:
                continue
            del waiting[job_id]
        if not waiting:
            return
        before = now if queries else before
        time.sleep(poll_every)


def _end_of(cell: Cell, job: Any) -> Event:
    error = job.exception()  # of the job itself: out of time too often, ...
    reason = job.result() if error is None else describe_error(error)
    return Event(cell, "failed", f"job {job.job_id}: {reason}") if reason else Event(cell, "done")


def _end_without_result(cell: Cell, root: Path, job: Any, state: str) -> Event:
    """Makes the event of a job that was killed, perhaps only after its last record was written."""
    if not snapshots_left(root, cell):
        return Event(cell, "done")
    text = f"job {job.job_id} ended without a result: {state}"
    log = job.paths.stderr
    lines: list[str] = log.read_text(errors="replace").splitlines() if log.exists() else []
    said = [line.strip() for line in lines if line.strip()]
    said = [line for line in said if "error" in line.lower()] or said
    return Event(cell, "failed", f"{text}; {log} says: {said[-1]}" if said else text)


def _ended_by_submitit(jobs: Sequence[Any], job_ids: Iterable[str]) -> dict[str, str]:
    """As `ended_jobs`, for submitit's other clusters."""
    wanted = set(job_ids)
    return {job.job_id: job.state for job in jobs if job.job_id in wanted and job.done()}


def _submitit() -> Any:
    try:
        import submitit
    except ImportError as error:
        raise ImportError(
            "--engine slurm needs the package submitit: pip install 'r3jax[slurm]'"
        ) from error
    return submitit
