"""Asks Slurm's queue which jobs have ended.

submitit asks `sacct`, which fails on clusters without an accounting database: a job that was
killed would be waited for without end. `squeue` works on all of them.
"""

import subprocess
from collections.abc import Iterable

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
"""States in which nothing runs or waits to run. All others, as of a job that is requeued, pass."""

_PATIENCE = 60.0
"""A controller that does not answer within this time is asked again later [s]."""


def ended_jobs(job_ids: Iterable[str]) -> dict[str, str]:
    """Jobs that have ended, with their state and its reason in words.

    Args:
        job_ids: as submitit has them: `12`, or `12_3` of an array.

    Returns:
        By id. Empty also when the controller does not answer: it may be back at the next look.

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
    """The jobs of `job_ids` that have ended, by lines `id|state|reason` of the queue.

    A job that is not listed ended so long ago that Slurm forgot it (its MinJobAge).
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
