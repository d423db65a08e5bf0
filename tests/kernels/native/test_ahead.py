"""Kernels are compiled beside a first command or planner, and once."""

import subprocess
import sys

import numpy as np
import pytest

import r3jax
from r3jax.kernels.native import ahead
from r3jax.planning import planner
from r3jax.simulators.scenes import registry

compile_ahead = ahead.compile_ahead.__wrapped__  # as in a new process


@pytest.fixture
def started(monkeypatch):
    calls = []
    monkeypatch.setattr(ahead.subprocess, "Popen", lambda words, **_: calls.append(words))
    return calls


def test_a_process_is_started_until_one_came_to_its_end(tmp_path, started):
    compile_ahead(tmp_path)
    compile_ahead(tmp_path)
    assert len(started) == 2
    note = started[0][-1]
    assert started[1][-1] == note
    tmp_path.joinpath(note).touch()
    compile_ahead(tmp_path)
    assert len(started) == 2


def test_other_sources_are_compiled_anew(tmp_path, started, monkeypatch):
    compile_ahead(tmp_path)
    monkeypatch.setattr(ahead, "version", lambda name: "0.0")
    compile_ahead(tmp_path)
    assert started[0][-1] != started[1][-1]


def test_a_program_that_embeds_python_is_not_started_once_more(tmp_path, started, monkeypatch):
    monkeypatch.setattr(ahead.sys, "executable", "/opt/blender/blender")
    compile_ahead(tmp_path)
    assert not started


def test_what_cannot_be_started_is_no_error(tmp_path, monkeypatch):
    def fail(*_, **__):
        raise OSError("no more processes")

    monkeypatch.setattr(ahead.subprocess, "Popen", fail)
    compile_ahead(tmp_path)


def test_a_planner_starts_it(monkeypatch):
    calls = []
    monkeypatch.setattr(planner, "compile_ahead", lambda: calls.append("started"))
    camera = r3jax.Camera.from_fov(32, 32)
    r3jax.start(camera, np.array([[0.0, 0, 0], [1, 1, 1]]), "random")
    assert calls == ["started"]


def test_a_scene_starts_it_unless_its_name_is_unknown(monkeypatch):
    calls = []
    monkeypatch.setattr(registry, "compile_ahead", lambda: calls.append("started"))
    with pytest.raises(ValueError, match="castle"):
        r3jax.open_scene("castle")
    assert calls == []
    r3jax.open_scene("flat", camera=r3jax.Camera.from_fov(32, 32))
    assert calls == ["started"]


@pytest.mark.full
def test_the_process_compiles_all_and_leaves_its_note(tmp_path):
    words = [sys.executable, "-m", ahead.COMPILER, str(tmp_path / "notes" / "note")]
    subprocess.run(words, check=True, timeout=600)
    assert (tmp_path / "notes" / "note").exists()
