"""Where Numba brings its own threads only, or cannot be used: the same maps, scores and models."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from r3jax.kernels.native import ffi, platform
from tests.kernels.native.small_use import use

_ROOT = Path(__file__).resolve().parents[3]


def used(*words: str, **settings: str) -> dict:
    done = subprocess.run(
        [sys.executable, "-m", "tests.kernels.native.small_use", *words],
        env={**os.environ, "JAX_PLATFORMS": "cpu", **settings},
        cwd=_ROOT,
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def usual():
    return use()


@pytest.mark.full
def test_several_threads_at_once_with_numbas_own_threads_only(usual):
    found = used("3", NUMBA_THREADING_LAYER="workqueue", NUMBA_NUM_THREADS="3")
    assert len(found["results"]) == 3
    for result in found["results"]:
        assert result == pytest.approx(usual, rel=1e-5)
    assert "workqueue" in found["kernels"]
    (said,) = found["said"]
    assert "libgomp1" in said


@pytest.mark.full
def test_without_numba_plain_jax_serves_and_says_so_once(usual):
    found = used("1", "hidden")
    assert found["results"][0] == pytest.approx(usual, rel=1e-3)
    assert found["kernels"].startswith("plain JAX")
    (said,) = found["said"]
    assert "plain JAX" in said
    assert "numba" in said.lower()


@pytest.fixture
def fresh():
    platform._start.cache_clear()
    yield
    platform._start.cache_clear()


def test_a_numba_that_fails_is_named(fresh, monkeypatch):
    def fail():
        raise SystemError("initialization of _internal failed\nwithout an exception")

    monkeypatch.setattr(ffi, "require_threads", fail)
    assert not platform.describe_kernels().startswith("machine code")
    assert "initialization of _internal failed" in platform.missing_for_machine_code()
    plain = platform.compiled_or_plain(lambda x: x + 1)
    assert plain(1) == 2


@pytest.mark.parametrize("layer", ["omp", "workqueue"])
def test_a_loop_of_any_size_is_done_once(layer):
    """Also inside of another loop, by threads that Numba would end the process for."""
    script = """
import numpy as np
from numba import njit, prange
from r3jax.kernels.native.ffi import require_threads
require_threads()

@njit(parallel=True)
def count(marks):
    for i in prange(marks.shape[0]):
        for j in prange(marks.shape[1]):
            marks[i, j] += 1

@njit(parallel=True)
def nested(marks):
    for i in prange(marks.shape[0]):
        count(marks[i])

for n in (0, 1, 2, 3, 17, 1000):
    marks = np.zeros((n, 3), np.int64)
    count(marks)
    assert (marks == 1).all(), n
marks = np.zeros((2, 4, 3), np.int64)
nested(marks)
assert (marks == 1).all()
"""
    done = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, "NUMBA_THREADING_LAYER": layer, "NUMBA_NUM_THREADS": "3"},
        cwd=_ROOT,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr[-2000:]
