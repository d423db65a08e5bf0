"""Writes are whole or not there, whoever else writes, and whatever fails."""

import os
import subprocess
import sys
import threading

import pytest

from r3jax.files import append_line, lock_folder, write_atomic


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_write_replaces_the_old_file_and_leaves_nothing_else(tmp_path):
    path = tmp_path / "a.json"
    write_atomic(path, b"old")
    write_atomic(path, b"new")
    assert path.read_bytes() == b"new"
    assert names(tmp_path) == ["a.json"]


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch, step):
    path = tmp_path / "a.json"
    write_atomic(path, b"old")

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, step, full)
    with pytest.raises(OSError, match="No space left"):
        write_atomic(path, b"new")
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == ["a.json"]


def test_many_writers_of_one_path_never_mix_nor_hurt_each_other(tmp_path):
    path = tmp_path / "a.bin"
    payloads = [bytes([i]) * 200_000 for i in range(8)]
    write_atomic(path, payloads[0])
    errors, done, seen = [], threading.Event(), set()

    def write(payload):
        try:
            for _ in range(10):
                write_atomic(path, payload)
        except OSError as error:
            errors.append(error)

    def read():
        while not done.is_set():
            seen.add(path.read_bytes())

    reader = threading.Thread(target=read)
    writers = [threading.Thread(target=write, args=(payload,)) for payload in payloads]
    reader.start()
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    done.set()
    reader.join()
    assert not errors
    assert seen <= set(payloads)
    assert path.read_bytes() in payloads
    assert names(tmp_path) == ["a.bin"]


def test_a_failed_append_is_taken_back(tmp_path, monkeypatch):
    path = tmp_path / "trace.jsonl"
    append_line(path, "one")

    def fail(descriptor):
        raise OSError(5, f"Input/output error on {descriptor}")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fail)
        with pytest.raises(OSError, match="Input/output"):
            append_line(path, "two")
    append_line(path, "three")
    assert path.read_text() == "one\nthree\n"


def test_a_lock_is_held_once_and_free_again_when_closed(tmp_path):
    with lock_folder(tmp_path), pytest.raises(BlockingIOError):
        lock_folder(tmp_path)
    lock_folder(tmp_path).close()


def test_a_pipe_in_the_place_of_the_lock_does_not_wait_for_ever(tmp_path):
    os.mkfifo(tmp_path / "lock")
    lock_folder(tmp_path).close()


def test_a_lock_dies_with_its_process(tmp_path):
    code = (
        "import sys, time, pathlib; from r3jax.files import lock_folder; "
        "lock = lock_folder(pathlib.Path(sys.argv[1])); print('held', flush=True); time.sleep(60)"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "held\n"
    with pytest.raises(BlockingIOError):
        lock_folder(tmp_path)
    process.kill()
    process.communicate()
    lock_folder(tmp_path).close()
