"""What a process may use."""

import os

from r3jax.kernels.native.platform import num_cores


def test_a_process_uses_the_cores_that_it_is_tied_to(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {3, 5}, raising=False)
    assert num_cores() == 2


def test_where_no_process_is_tied_to_cores_all_are_used(monkeypatch):
    """As on macOS, whose Python has no such call."""
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 6)
    assert num_cores() == 6
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert num_cores() == 1
