"""What is made of the answers of Slurm's queue; the real one is asked in `test_slurm.py`."""

import pytest

from r3jax.apps.benchmark.engines.slurm_queue import ended_jobs, read_queue

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
