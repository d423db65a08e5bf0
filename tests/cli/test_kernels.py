"""Kernels are compiled beside a first command, and once."""

import subprocess
import sys

import pytest

from r3jax.cli import kernels


@pytest.fixture
def started(monkeypatch):
    calls = []
    monkeypatch.setattr(kernels.subprocess, "Popen", lambda words, **_: calls.append(words))
    return calls


def test_a_process_is_started_until_one_came_to_its_end(tmp_path, started):
    kernels.compile_ahead(tmp_path)
    kernels.compile_ahead(tmp_path)
    assert len(started) == 2
    note = started[0][-1]
    assert started[1][-1] == note
    tmp_path.joinpath(note).touch()
    kernels.compile_ahead(tmp_path)
    assert len(started) == 2


def test_other_sources_are_compiled_anew(tmp_path, started, monkeypatch):
    kernels.compile_ahead(tmp_path)
    monkeypatch.setattr(kernels, "version", lambda name: "0.0")
    kernels.compile_ahead(tmp_path)
    assert started[0][-1] != started[1][-1]


def test_what_cannot_be_started_is_no_error(tmp_path, monkeypatch):
    def fail(*_, **__):
        raise OSError("no more processes")

    monkeypatch.setattr(kernels.subprocess, "Popen", fail)
    kernels.compile_ahead(tmp_path)


@pytest.mark.full
def test_the_process_compiles_all_and_leaves_its_note(tmp_path):
    words = [sys.executable, "-m", "r3jax.cli.kernels", str(tmp_path / "notes" / "note")]
    subprocess.run(words, check=True, timeout=600)
    assert (tmp_path / "notes" / "note").exists()
