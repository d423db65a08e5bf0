"""`r3jax view` and `explore --live`, as a user meets them."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import time

import pytest

from r3jax.cli.main import main
from r3jax.runs.reader import read_run
from tests.box_room import write_room
from tests.cli.small_runs import explore


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    folder = tmp_path_factory.mktemp("view")
    assert explore(write_room(folder / "room.ply"), folder) == 0
    return folder / "box"


def say(words, capsys) -> str:
    """Runs a command that must fail with one line; the line."""
    assert main([str(word) for word in words]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    lines = captured.err.strip().splitlines()
    assert lines[-1].startswith("r3jax: ")
    return lines[-1]


@pytest.fixture
def busy_port():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        yield other.getsockname()[1]


def test_a_run_without_views_is_told(path, tmp_path, capsys):
    copy = shutil.copytree(path, tmp_path / "copy")
    (copy / "trace.jsonl").write_text("")
    for words in ([], ["--export", tmp_path / "out"]):
        assert "no views yet" in say(["view", copy, *words], capsys)
    assert not (tmp_path / "out").exists()


def test_a_port_in_use_is_told(path, busy_port, capsys):
    pytest.importorskip("viser", reason="the viewer needs viser, which is not installed")
    line = say(["view", path, "--port", busy_port], capsys)
    assert f"{busy_port}" in line


def test_a_port_in_use_leaves_no_run_behind(tmp_path, busy_port, capsys):
    pytest.importorskip("viser", reason="the viewer needs viser, which is not installed")
    room, out = write_room(tmp_path / "room.ply"), tmp_path / "runs"
    assert explore(room, out, "--live", "--port", str(busy_port)) == 2
    assert "--port" in capsys.readouterr().err
    assert not out.exists()


def test_without_viser_the_extra_is_named(path, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert "pip install 'r3jax[viewer]'" in say(["view", path], capsys)
    room = write_room(tmp_path / "room.ply")
    assert explore(room, tmp_path / "runs", "--live") == 2
    assert "pip install 'r3jax[viewer]'" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


def test_without_av_the_extra_is_named_before_anything_is_drawn(
    path, tmp_path, capsys, monkeypatch
):
    monkeypatch.setitem(sys.modules, "av", None)
    out = tmp_path / "out"
    line = say(["view", path, "--export", out, "--video"], capsys)
    assert "pip install 'r3jax[viewer]'" in line
    assert not out.exists()


def test_a_model_that_is_not_there_is_told(path, capsys):
    pytest.importorskip("viser", reason="the viewer needs viser, which is not installed")
    line = say(["view", path, "--port", "0", "--name", "other"], capsys)
    assert "there is no such model; there is none yet" in line
    line = say(["view", path, "--port", "0", "--name", "../other"], capsys)
    assert "without a path" in line


def test_a_folder_that_holds_something_is_told(path, tmp_path, capsys):
    (tmp_path / "mine.txt").write_text("mine")
    assert "something is there already" in say(["view", path, "--export", tmp_path], capsys)


@pytest.mark.full
def test_pictures_are_written_without_viser_and_the_run_stays_as_it_is(
    path, tmp_path, capsys, monkeypatch
):
    monkeypatch.setitem(sys.modules, "viser", None)
    before = {p: p.read_bytes() for p in path.rglob("*") if p.is_file()}
    out = tmp_path / "deep" / "out"
    assert main(["view", str(path), "--export", str(out)]) == 0
    assert str(out / "oblique-renderability.png") in capsys.readouterr().err
    assert len(list((out / "views").iterdir())) == len(read_run(path).rows)
    assert {p: p.read_bytes() for p in path.rglob("*") if p.is_file()} == before


def test_a_page_is_shown_until_it_is_interrupted(path, capsys, monkeypatch):
    pytest.importorskip("viser", reason="the viewer needs viser, which is not installed")
    from r3jax.cli.commands import runs

    monkeypatch.setattr(runs.time, "sleep", lambda _: os.kill(os.getpid(), signal.SIGINT))
    codes = []
    monkeypatch.setattr(runs, "end_process", codes.append)
    main(["view", str(path), "--port", "0"])
    assert codes == [0]
    shown = capsys.readouterr()
    assert "view      http://127.0.0.1:" in shown.err
    assert shown.out == ""


@pytest.mark.full
def test_ctrl_c_ends_the_page_while_it_works_out_its_first_answer(path, tmp_path):
    """For which it has to compile: half a minute that Ctrl-C used to wait for."""
    pytest.importorskip("viser", reason="the viewer needs viser, which is not installed")
    environment = {
        **os.environ,
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path),
        "PYTHONUNBUFFERED": "1",
    }
    words = [sys.executable, "-c", "from r3jax.cli.main import main; raise SystemExit(main())"]
    words += ["view", str(path), "--port", "0", "--no-scene"]
    with subprocess.Popen(words, env=environment, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        try:
            while "Ctrl-C ends it" not in (line := process.stderr.readline()):
                assert line, "the page has not been shown"
            begun = time.monotonic()
            process.send_signal(signal.SIGINT)
            assert process.wait(timeout=60) == 0
            assert time.monotonic() - begun < 2.0
            assert "Traceback" not in process.stderr.read()
        finally:
            process.kill()
