"""Ctrl-C is obeyed wherever it falls: also where Python, or a library, drops its exception."""

import contextlib
import gc
import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from r3jax import interrupts
from r3jax.cli import command_line
from r3jax.cli.console import Console, RunProgress, Stages
from r3jax.cli.main import main
from r3jax.exploration.config import Budget
from r3jax.interrupts import (
    caught_interrupts,
    check_interrupt,
    deferred_interrupt,
    settle_interrupt,
)
from r3jax.runs.reader import read_run
from r3jax.simulators.raycast.raycast import RaycastSimulator
from tests.box_room import write_room
from tests.cli.small_runs import explore


def press():
    """Sends Ctrl-C; its handler has run before the call returns."""
    os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT)


class Finalizer:
    def __del__(self):
        press()


def drop_in_a_finalizer():
    Finalizer()


def drop_in_a_callback_of_the_collector():
    """As JAX's is called."""
    callback = lambda phase, info: press() if phase == "start" else None
    gc.callbacks.append(callback)
    gc.collect(0)
    gc.callbacks.remove(callback)


def drop_in_a_library():
    with contextlib.suppress(KeyboardInterrupt):
        press()


@pytest.mark.parametrize("drop", [drop_in_a_finalizer, drop_in_a_callback_of_the_collector])
def test_what_python_drops_is_raised_again_and_ends_a_wait(drop):
    begun = time.monotonic()
    with caught_interrupts(), pytest.raises(KeyboardInterrupt):  # noqa: PT012
        drop()
        threading.Event().wait(20)
    assert time.monotonic() - begun < 10
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_what_a_library_drops_is_raised_at_the_next_step():
    with caught_interrupts():
        drop_in_a_library()
        for _ in range(2):  # until somebody says that it has ended what it should
            with pytest.raises(KeyboardInterrupt):
                check_interrupt()
        settle_interrupt()
        check_interrupt()
    check_interrupt()


def test_all_progress_is_a_step():
    console = Console(file=open(os.devnull, "w"))  # noqa: SIM115
    run, stages = RunProgress(console, Budget("views", 3.0)), Stages(console)
    steps = (
        lambda: run.on_stage("plan"),
        lambda: stages.on_progress("mapping", 3),
        lambda: stages.on_progress("", 1),
        lambda: next(stages.each("reading", [1], 1)),
        lambda: console.status("planning ...").update("more"),
    )
    for step in steps:
        step()
        with caught_interrupts():
            drop_in_a_library()
            with pytest.raises(KeyboardInterrupt):
                step()
    console.file.close()


def test_what_must_not_be_torn_is_not():
    with caught_interrupts():
        with deferred_interrupt() as was_interrupted:
            assert not was_interrupted()
            press()
            assert was_interrupted()
        with pytest.raises(KeyboardInterrupt):
            check_interrupt()


@pytest.mark.parametrize("handler", [signal.SIG_IGN, lambda *_: None])
def test_a_handler_that_was_there_stays(handler):
    signal.signal(signal.SIGINT, handler)
    try:
        with caught_interrupts(), deferred_interrupt():
            assert signal.getsignal(signal.SIGINT) is handler
            press()
            check_interrupt()
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def test_a_thread_installs_nothing():
    def body():
        with caught_interrupts(), deferred_interrupt() as was_interrupted:
            seen.append((signal.getsignal(signal.SIGINT), was_interrupted()))

    seen = []
    thread = threading.Thread(target=body)
    thread.start()
    thread.join()
    assert seen == [(signal.default_int_handler, False)]


def run(program, **settings):
    return subprocess.Popen(
        [sys.executable, "-c", program], stdout=-1, stderr=-1, text=True, **settings
    )


def test_a_second_ctrl_c_ends_the_process():
    program = (
        "import time\nfrom r3jax.interrupts import caught_interrupts\n"
        "with caught_interrupts():\n"
        "    try:\n        print('begun', flush=True); time.sleep(60)\n"
        "    except KeyboardInterrupt:\n        print('first', flush=True); time.sleep(60)\n"
    )
    with run(program) as process:
        for word in ("begun", "first"):
            assert process.stdout.readline().strip() == word
            process.send_signal(signal.SIGINT)
        assert process.wait(timeout=10) == interrupts.INTERRUPTED
        assert process.stderr.read() == ""


@pytest.mark.parametrize("module", ["tyro", "r3jax.cli.options", "numpy"])
def test_ctrl_c_while_modules_load_shows_no_traceback(module):
    program = (
        "import os, signal, sys\n"
        "class Finder:\n    def find_spec(self, name, path, target=None):\n"
        f"        if name == {module!r}: os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Finder())\n"
        "from r3jax.cli import main\nsys.exit(main(['explore', '--scene', 'nowhere']))\n"
    )
    with run(program) as process:
        said = process.communicate(timeout=60)[1]
    assert process.returncode == interrupts.INTERRUPTED, said
    assert said.startswith("r3jax: interrupted")
    assert "Traceback" not in said


def test_an_error_that_a_library_makes_of_it_is_the_interrupt(monkeypatch, capsys):
    def run_command(args):
        drop_in_a_library()
        raise RuntimeError("INTERNAL: KeyboardInterrupt")

    monkeypatch.setattr(command_line, "run_command", run_command)
    assert main([]) == interrupts.INTERRUPTED
    assert "interrupted" in capsys.readouterr().err


@pytest.mark.parametrize("drop", [drop_in_a_finalizer, drop_in_a_library])
def test_a_run_ends_where_the_exception_was_dropped(tmp_path, monkeypatch, capsys, drop):
    real, count = RaycastSimulator.render, iter(range(10))

    def render(self, T_world_camera):
        if next(count) == 1:
            drop()
        return real(self, T_world_camera)

    monkeypatch.setattr(RaycastSimulator, "render", render)
    assert explore(write_room(tmp_path / "room.ply"), tmp_path) == interrupts.INTERRUPTED
    assert f"r3jax explore --resume {tmp_path / 'box'}" in capsys.readouterr().err
    assert len(read_run(tmp_path / "box").rows) == 1
