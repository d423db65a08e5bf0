"""Engines: however many processes, whatever dies, and on a cluster: the same records."""

import dataclasses
import multiprocessing
import os
import signal
import sys
import threading
import time
from pathlib import Path

import pytest

from r3jax.apps.benchmark.cells import Cell, paths_of
from r3jax.apps.benchmark.engines import local
from r3jax.apps.benchmark.engines.local import run_here, run_in_processes, worker_environments
from r3jax.apps.benchmark.engines.slurm import run_on_cluster
from r3jax.apps.benchmark.plan import cells_left
from r3jax.apps.benchmark.record import read_records
from tests.apps.benchmark.test_run_cell import without_clock
from tests.apps.benchmark.tiny import make_cells


def broken(cell: Cell) -> Cell:
    """The same with a scene that is not the one that was planned."""
    return dataclasses.replace(cell, scene_hash="0" * 64)


def ends(events):
    return [(event.cell.seed, event.kind) for event in events if event.kind in ("done", "failed")]


def assert_same_records(root, expected_root, expected_cells=None):
    found, expected = read_records(root), read_records(expected_root, expected_cells)
    assert list(map(without_clock, found)) == list(map(without_clock, expected))


@pytest.mark.full
def test_two_processes_of_which_one_is_killed_give_the_same_records(finished, room, tmp_path):
    cells = make_cells(room, tmp_path, seeds=(0, 1))
    bad = broken(dataclasses.replace(cells[0], seed=2))
    events, killed = [], []

    def report(event):
        events.append(event)
        if event.cell.seed == 0 and event.kind == "stage" and not killed:
            # The first process that was started has the first cell.
            victim = min(multiprocessing.active_children(), key=lambda process: process.pid)
            killed.append(victim)
            victim.kill()

    run_in_processes([cells[0], bad, cells[1]], tmp_path, report, jobs=2)
    assert sorted(ends(events)) == [(0, "failed"), (1, "done"), (2, "failed")]
    reasons = {event.cell.seed: event.text for event in events if event.kind == "failed"}
    assert "its process was killed" in reasons[0]
    assert "000000000000" in reasons[2]
    assert cells_left(tmp_path, cells) == (cells[0],)
    run_here([cells[0]], tmp_path, events.append)
    assert ends(events)[-1] == (0, "done")
    assert_same_records(tmp_path, finished[0])
    assert not multiprocessing.active_children()


@pytest.mark.full
def test_a_cell_that_fails_does_not_stop_the_others(finished, room, tmp_path):
    good, other = make_cells(room, tmp_path, seeds=(0, 1))
    events = []
    run_here([broken(good), good, other], tmp_path, events.append)
    assert ends(events) == [(0, "failed"), (0, "done"), (1, "done")]
    assert_same_records(tmp_path, finished[0])
    error = paths_of(tmp_path, broken(good)).error.read_text()
    assert error.startswith("Traceback")
    assert not paths_of(tmp_path, good).error.exists()


def test_no_process_is_started_without_work_and_none_below_one(tmp_path):
    run_in_processes([], tmp_path, print, jobs=3)
    with pytest.raises(ValueError, match=r"jobs.*0"):
        run_in_processes([], tmp_path, print, jobs=0)


def test_each_worker_has_a_gpu_or_its_share(monkeypatch):
    for name in ("NUMBA_NUM_THREADS", "XLA_PYTHON_CLIENT_MEM_FRACTION"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2, 5")
    assert worker_environments(2) == [{"CUDA_VISIBLE_DEVICES": gpu} for gpu in "25"]
    crowded = worker_environments(3)
    assert [worker["CUDA_VISIBLE_DEVICES"] for worker in crowded] == ["2", "5", "2"]
    assert {worker["XLA_PYTHON_CLIENT_MEM_FRACTION"] for worker in crowded} == {"0.450"}
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "-1")
    monkeypatch.setattr(local, "num_cores", lambda: 7)
    assert worker_environments(3) == [{"NUMBA_NUM_THREADS": "2"}] * 3
    monkeypatch.setenv("NUMBA_NUM_THREADS", "1")
    assert worker_environments(2) == [{}, {}]


def children_of(pid):
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


@pytest.mark.slow
def test_on_a_cluster_a_job_that_is_preempted_goes_on_with_its_cell(finished, room, tmp_path):
    """submitit's own local substitute for a cluster: each job a process, preempted by a signal."""
    pytest.importorskip("submitit")
    cells = make_cells(room, tmp_path)
    bad, good = broken(cells[0]), cells[0]
    events = []
    options = {"jobs": 2, "cluster": "local", "poll_every": 0.1}
    engine = threading.Thread(
        target=run_on_cluster, args=([bad, good], tmp_path, events.append), kwargs=options
    )
    engine.start()
    trace = paths_of(tmp_path, good).run / "trace.jsonl"
    while engine.is_alive() and not (trace.exists() and trace.stat().st_size):
        time.sleep(0.02)
    job = next(e.text for e in events if (e.cell, e.kind) == (good, "started")).split()[-1]
    for task in children_of(job):
        os.kill(task, signal.SIGUSR2)
    engine.join()
    assert sorted(event.kind for event in events) == ["done", "failed", "started", "started"]
    assert "000000000000" in next(e.text for e in events if e.kind == "failed")
    logs = "".join(log.read_text() for log in (tmp_path / "slurm").glob(f"{job}_*log.*"))
    assert f"Requeued job {job}" in logs
    assert_same_records(tmp_path, finished[0], finished[1][:1])


def test_slurm_without_submitit_names_the_extra(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "submitit", None)
    with pytest.raises(ImportError, match=r"r3jax\[slurm\]"):
        run_on_cluster([], tmp_path, print)
