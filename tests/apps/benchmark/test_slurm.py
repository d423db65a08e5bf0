"""The cluster engine on a real Slurm: a node on this machine, jobs requeued and killed on it.

What is made of the answers of Slurm's queue; the real one is asked in `test_slurm.py`.
"""

import os
import shutil
import signal
import tempfile
import threading
import time
from pathlib import Path

import pytest

from r3jax.apps.benchmark.cells import paths_of, snapshots_left
from r3jax.apps.benchmark.engines.slurm import ended_jobs, read_queue, run_on_cluster
from r3jax.apps.benchmark.plan import cells_left
from r3jax.runs.reader import read_run
from tests.apps.benchmark.test_engines import assert_same_records, ends
from tests.apps.benchmark.tiny import make_cells
from tests.slurm import cluster

LISTING = """\
7_0|COMPLETED|None
7_1|RUNNING|None
7_2|FAILED|NonZeroExitCode
7_10|COMPLETING|None
7_11|PENDING|BeginTime
7_12|CANCELLED|None
7_13|REQUEUE_HOLD|job requeued in held state
8|OUT_OF_MEMORY|OutOfMemory
"""


def test_a_job_has_ended_when_the_queue_says_so_or_forgot_it():
    assert read_queue(["7_0", "7_1", "7_10", "7_11", "7_13", "8", "9"], LISTING) == {
        "7_0": "COMPLETED",
        "8": "OUT_OF_MEMORY (OutOfMemory)",
        "9": "no longer in the queue",
    }
    assert read_queue(["7_12", "7_2"], LISTING) == {
        "7_12": "CANCELLED",
        "7_2": "FAILED (NonZeroExitCode)",
    }


@pytest.fixture
def answer(tmp_path, monkeypatch):
    """`answer(script)` makes a shell script the queue."""
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")

    def install(script):
        (tmp_path / "squeue").write_text(f"#!/bin/sh\n{script}\n")
        (tmp_path / "squeue").chmod(0o755)

    return install


def test_all_tasks_of_an_array_are_asked_for_at_once(answer):
    answer('for last; do :; done; echo "7_0|FAILED|$last"')
    assert ended_jobs(["7_0", "8"])["7_0"] == "FAILED (--jobs=7,8)"


def test_a_controller_that_does_not_answer_ends_no_job(answer):
    answer("echo slurm_load_jobs error: Unable to contact slurm controller >&2; exit 1")
    assert ended_jobs(["7_0"]) == {}
    answer("echo slurm_load_jobs error: Invalid job id specified >&2; exit 1")
    assert ended_jobs(["7_0"]) == {"7_0": "no longer in the queue"}


ABSENT = ", ".join(cluster.missing())
pytestmark = [
    pytest.mark.full,
    pytest.mark.slurm,
    pytest.mark.skipif(bool(ABSENT), reason=f"needs {ABSENT} (apt-get install slurm-wlm munge)"),
]


@pytest.fixture(scope="module")
def slurm():
    """The folder of a cluster that runs, with this process set to use it."""
    pytest.importorskip("submitit")
    folder = Path(tempfile.mkdtemp(prefix="slurm-"))  # pytest's own are too long for a socket
    with pytest.MonkeyPatch.context() as patch:
        for name, value in cluster.start(folder).items():
            patch.setenv(name, value)
        yield folder
        cluster.stop(folder)
    shutil.rmtree(folder)


class Engine:
    """`run_on_cluster` in a thread, and what it told."""

    def __init__(self, cells, root):
        self.events = []
        self._arguments = (cells, root, self.events.append)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self):
        run_on_cluster(*self._arguments, jobs=2, poll_every=0.2)

    def join(self):
        self._thread.join(timeout=240)
        assert not self._thread.is_alive()
        return self.events

    def job_of(self, cell):
        told = lambda: [e.text for e in self.events if (e.cell, e.kind) == (cell, "started")]
        return until(told)[0].removeprefix("job ")


def until(found, patience=240):
    """What `found()` returns as soon as that is something."""
    end = time.monotonic() + patience
    while not (it := found()):
        assert time.monotonic() < end
        time.sleep(0.01)
    return it


def stopped_in_the_middle(root, cell):
    """The process that is at a cell, stopped while it explores."""
    paths = paths_of(root, cell)
    trace = paths.run / "trace.jsonl"
    until(lambda: trace.exists() and trace.stat().st_size)
    inode = str((paths.folder / "lock").stat().st_ino)
    locks = [line.split() for line in Path("/proc/locks").read_text().splitlines()]
    (task,) = {int(lock[4]) for lock in locks if lock[5].split(":")[-1] == inode}
    os.kill(task, signal.SIGSTOP)
    assert snapshots_left(root, cell) == cell.conditions.snapshots
    return task


def log_of(root, job):
    return "".join(log.read_text() for log in (root / "slurm").glob(f"{job}_*log.*"))


def test_jobs_that_are_preempted_and_requeued_go_on_with_their_cells(
    slurm, finished, room, tmp_path
):
    """One gets the signal before its time is out, the other is put back by an administrator."""
    cells = make_cells(room, tmp_path, seeds=(0, 1))
    engine = Engine(cells, tmp_path)
    signaled, requeued = (engine.job_of(cell) for cell in cells)
    for cell in cells:
        stopped_in_the_middle(tmp_path, cell)
    cluster.command(slurm, "scontrol", "requeue", requeued)
    cluster.command(slurm, "scancel", "--signal=USR2", signaled)
    cluster.command(slurm, "scancel", "--signal=CONT", signaled)
    assert sorted(ends(engine.join())) == [(0, "done"), (1, "done")]
    assert f"Requeued job {signaled}" in log_of(tmp_path, signaled)
    for job in (signaled, requeued):
        assert "Restarts=1" in cluster.command(slurm, "scontrol", "show", "job", job).stdout
    assert_same_records(tmp_path, finished[0])


@pytest.mark.slow
def test_a_job_that_is_killed_fails_alone_and_the_next_benchmark_ends_its_cell(
    slurm, finished, room, tmp_path
):
    cells = make_cells(room, tmp_path, seeds=(0, 1))
    engine = Engine(cells, tmp_path)
    job = engine.job_of(cells[0])
    os.kill(stopped_in_the_middle(tmp_path, cells[0]), signal.SIGKILL)
    assert sorted(ends(engine.join())) == [(0, "failed"), (1, "done")]
    (text,) = (event.text for event in engine.events if event.kind == "failed")
    assert f"job {job} ended without a result: FAILED (NonZeroExitCode)" in text
    assert "task 0: Killed" in text
    assert_same_records(tmp_path, finished[0], finished[1][1:])  # of the job left in peace
    assert cells_left(tmp_path, cells) == cells[:1]
    assert read_run(paths_of(tmp_path, cells[0]).run).end is None
    assert ends(Engine(cells[:1], tmp_path).join()) == [(0, "done")]
    assert_same_records(tmp_path, finished[0])
