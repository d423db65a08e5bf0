"""Writes are whole or not there, whoever else writes, and whatever fails."""

import contextlib
import os
import subprocess
import sys
import threading

import pytest

from r3jax.files import (
    MARKER,
    NotOursError,
    append_line,
    check_own,
    check_replaceable,
    clear_partial,
    disown_folder,
    is_own,
    lock_file,
    lock_folder,
    make_folder,
    own_folder,
    remove,
    remove_own,
    whole_folder,
    write_atomic,
)


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


@pytest.mark.parametrize("hide", ["", "import sys; sys.modules['fcntl'] = None\n"])
def test_a_platform_without_locks_is_done_without_them_and_says_so_once(tmp_path, hide):
    code = (
        "import pathlib, sys; from r3jax.files import lock_folder; "
        "held = [lock_folder(pathlib.Path(sys.argv[1])) for _ in (1, 2)]"
    )
    command = [sys.executable, "-c", hide + code, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode == 0) == bool(hide)
    assert done.stderr.count("no file locks") == (1 if hide else 0)


@pytest.mark.parametrize("make", [os.symlink, os.link])
def test_a_lock_neither_follows_a_link_nor_changes_a_file(tmp_path, make):
    (tmp_path / "mine").write_text("x")
    make(tmp_path / "mine", tmp_path / "lock")
    if make is os.symlink:
        with pytest.raises(OSError, match="lock"):
            lock_file(tmp_path / "lock")
    else:
        lock_file(tmp_path / "lock").close()
    assert (tmp_path / "mine").read_text() == "x"


@pytest.fixture
def ours(tmp_path):
    own_folder(tmp_path / "r3", "run")
    return tmp_path / "r3"


@pytest.fixture
def victim(tmp_path):
    """A folder of somebody else, with names that we give, too."""
    folder = tmp_path / "victim"
    (folder / "sub").mkdir(parents=True)
    for name in ("a.json", "lock", "sub/a.json"):
        (folder / name).write_text("mine")
    return folder


def state(folder):
    return {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize(
    "write",
    [
        lambda folder: write_atomic(folder / "a.json", b"x"),
        lambda folder: write_atomic(folder / "sub" / "a.json", b"x"),
        lambda folder: append_line(folder / "a.json", "x"),
        lambda folder: make_folder(folder / "new"),
        lambda folder: own_folder(folder / "new", "model"),
        lambda folder: remove(folder / "a.json"),
        lambda folder: lock_folder(folder),
        lambda folder: whole_folder(folder / "new").__enter__(),
    ],
)
def test_nothing_is_done_through_a_link_in_a_folder_of_ours(ours, victim, write):
    before = sorted(victim.rglob("*"))
    (ours / "linked").symlink_to(victim)
    content = state(victim)
    with pytest.raises(NotOursError, match=r"linked: .*link"):
        write(ours / "linked")
    assert state(victim) == content
    assert sorted(victim.rglob("*")) == before


def test_links_above_a_folder_of_ours_are_the_users(ours, tmp_path):
    (tmp_path / "link").symlink_to(ours)
    write_atomic(tmp_path / "link" / "a.json", b"x")
    assert (ours / "a.json").read_bytes() == b"x"


def test_a_link_in_the_place_of_a_file_is_replaced_and_never_appended_to(ours, victim):
    for name in ("a.json", "b.json"):
        (ours / name).symlink_to(victim / "a.json")
    write_atomic(ours / "a.json", b"x")
    with pytest.raises(NotOursError, match=r"b\.json: .*link"):
        append_line(ours / "b.json", "x")
    assert (victim / "a.json").read_text() == "mine"
    assert not (ours / "a.json").is_symlink()


def test_a_line_is_not_appended_to_the_other_names_of_a_file(tmp_path):
    append_line(tmp_path / "trace", "one")
    os.link(tmp_path / "trace", tmp_path / "copy")
    for line in ("two", "three"):
        append_line(tmp_path / "copy", line)
    assert (tmp_path / "trace").read_text() == "one\n"
    assert (tmp_path / "copy").read_text() == "one\ntwo\nthree\n"


def test_what_a_killed_write_left_is_cleared_and_no_file_of_such_a_name_elsewhere(ours):
    left, mine = ours / MARKER / ".a.0123abcd.partial", ours / ".mine.0123abcd.partial"
    mine.write_text("mine")
    (left / "sub").mkdir(parents=True)
    (ours / MARKER / ".b.0123abcd.partial").write_text("half")
    clear_partial(ours)
    assert names(ours / MARKER) == ["marker"]
    assert mine.read_text() == "mine"


def test_a_folder_is_ours_by_its_marker_or_by_what_earlier_versions_wrote(tmp_path):
    folder = tmp_path / "audit"
    folder.mkdir()
    (folder / "audit.json").write_text("not r3jax's")
    with pytest.raises(NotOursError, match=r"audit: .*--out"):
        own_folder(folder, "audit", "give another --out")
    assert names(folder) == ["audit.json"]
    (folder / "audit.json").write_text('{"format": 1, "pictures_used": [], "depth_from": "z"}')
    own_folder(folder, "audit")
    (folder / "audit.json").unlink()
    assert is_own(folder, "audit")
    with pytest.raises(NotOursError, match="not a run"):
        check_own(folder, "run")
    disown_folder(folder)
    assert not names(folder)


def test_a_folder_named_as_the_marker_makes_nothing_ours(tmp_path, ours):
    folder = tmp_path / "theirs"
    folder.mkdir()
    (folder / MARKER).symlink_to(ours / MARKER)
    with pytest.raises(NotOursError):
        own_folder(folder, "run")
    (folder / MARKER).unlink()
    (folder / MARKER).mkdir()
    (folder / MARKER / "marker").write_text("somebody's")
    with pytest.raises(NotOursError):
        own_folder(folder, "run")


@pytest.mark.parametrize("left", [[], ["lock"], [MARKER + "/marker"]])
def test_what_a_process_left_that_was_killed_at_once_is_no_obstacle(tmp_path, left):
    for name in left:
        (tmp_path / "run" / name).parent.mkdir(parents=True)
        (tmp_path / "run" / name).touch()
    own_folder(tmp_path / "run", "run")
    assert is_own(tmp_path / "run", "run")


def test_what_the_user_keeps_among_our_names_stays(ours):
    for name in ("frames/1.png", "frames/mine.txt", "other/1.png"):
        make_folder((ours / name).parent)
        (ours / name).write_text("x")
    remove_own(ours, ["frames/[0-9].png", "frames", "nothing"])
    assert {p.relative_to(ours).as_posix() for p in ours.rglob("*.*") if p.is_file()} == {
        "frames/mine.txt",
        "other/1.png",
    }


def test_of_two_that_make_a_folder_at_once_one_is_told_so(tmp_path):
    out = tmp_path / "out"
    with contextlib.ExitStack() as stack:
        (stack.enter_context(whole_folder(out)) / "b").touch()
        with whole_folder(out) as first:
            (first / "a").touch()
        with pytest.raises(NotOursError, match="out"):
            stack.close()
    assert names(out) == ["a"]
    assert names(tmp_path) == ["out"]


def test_a_file_that_the_user_named_is_replaced_only_if_it_is_ours(tmp_path):
    path = tmp_path / "plot.png"
    check_replaceable(path, b"r3jax")
    path.write_bytes(b"of r3jax")
    check_replaceable(path, b"r3jax")
    (tmp_path / "link.png").symlink_to(path)
    (tmp_path / "photo.png").write_bytes(b"mine")
    for name in ("link.png", "photo.png"):
        with pytest.raises(NotOursError, match=name):
            check_replaceable(tmp_path / name, b"r3jax")
