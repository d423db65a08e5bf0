"""Candidates spread over devices: in a process with four, and that one device is left alone."""

import functools
import os
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.scoring import batch

pytestmark = pytest.mark.full

ROOT = Path(__file__).resolve().parents[2]


def test_on_four_devices():
    """See `four_devices.py`: how many devices there are is settled when JAX starts."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=4"
    ran = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:xdist", "tests/scoring/four_devices.py"],
        cwd=ROOT,
        env=os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    summary = ran.stdout.splitlines()[-1]
    assert " passed" in summary
    assert "skipped" not in summary


def test_one_device_is_left_alone(monkeypatch):
    monkeypatch.setattr(batch, "score_on_devices", None)
    score = functools.partial(lambda scale, candidates: scale * candidates, 2.0)
    for count in (1, 4, 7):
        candidates = jnp.arange(count, dtype=jnp.float32)
        np.testing.assert_array_equal(
            batch.map_over_devices(score, candidates), 2.0 * np.arange(count)
        )
