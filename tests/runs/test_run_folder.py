"""A run folder: written, read back, damaged, full, locked, overwritten."""

import errno
import json
import os
import re
import shutil
import subprocess
import threading
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
import pytest

from r3jax.exploration.state import RecordingStopped
from r3jax.runs.header import RunError
from r3jax.runs.reader import read_run
from r3jax.runs.rows import to_json
from r3jax.runs.writer import RunWriter
from tests.runs.runs import make_header, make_view


def write_run(path, views=3, end=True, **kwargs):
    with RunWriter(path, make_header(), **kwargs) as writer:
        for step in range(views):
            writer.add(*make_view(step))
            writer.add_timings(step, {"plan": 0.5, "render": 0.25})
        if end:
            writer.finish("budget", "enough")
    return path


def assert_trees_equal(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_what_is_written_is_read_back_bit_for_bit(tmp_path):
    run = read_run(write_run(tmp_path / "run"))
    assert run.header == make_header()
    assert run.end is not None
    assert (run.end.outcome, run.end.views) == ("budget", 3)
    for step, frame in enumerate(run.frames()):
        row, original = make_view(step)
        assert to_json(run.rows[step]) == to_json(row)
        assert_trees_equal(frame, original)
    assert [t["plan"] for t in run.timings] == [0.5] * 3


def test_a_run_is_complete_after_every_view(tmp_path):
    with RunWriter(tmp_path / "run", make_header()) as writer:
        for step in range(2):
            writer.add(*make_view(step))
            run = read_run(tmp_path / "run")  # while the writer is still at it
            assert len(run.rows) == step + 1
            assert_trees_equal(run.frame(step), make_view(step)[1])
            assert run.end is None
            assert "cut off" in run.outcome


@pytest.mark.parametrize("cut", [1, 30, 200])
def test_a_torn_last_row_is_left_out(tmp_path, cut):
    trace = write_run(tmp_path / "run", end=False) / "trace.jsonl"
    os.truncate(trace, trace.stat().st_size - cut)
    assert len(read_run(tmp_path / "run").rows) == 2


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (lambda a, b, *rest: [a, b[:50], *rest], "line 2"),
        (lambda a, b, *rest: [a, *rest], "view 1"),
    ],
)
def test_a_damaged_or_missing_row_is_named(tmp_path, lines, message):
    trace = write_run(tmp_path / "run") / "trace.jsonl"
    trace.write_text("\n".join(lines(*trace.read_text().splitlines())) + "\n")
    with pytest.raises(RunError, match=rf"trace\.jsonl: .*{message}"):
        read_run(tmp_path / "run")


def test_an_image_that_was_swapped_is_found(tmp_path):
    run = read_run(write_run(tmp_path / "run"))
    run.image_path(1).write_bytes(run.image_path(2).read_bytes())
    run.frame(0)
    with pytest.raises(RunError, match=r"000001\.png"):
        run.frame(1)


@pytest.mark.parametrize(
    "change",
    [
        {"version": 4},
        {"version": 0},
        {"format": "other"},
        {"camera": {"width": 8}},
        {"surprise": 1},
        {"seed": 4},  # under its seal
    ],
)
def test_another_header_is_refused(tmp_path, change):
    path = write_run(tmp_path / "run") / "run.json"
    plain = json.loads(path.read_text()) | change
    if "seed" not in change:  # changed by hand: the seal has to go
        del plain["seal"]
    path.write_text(json.dumps(plain))
    with pytest.raises(RunError, match=r"run\.json"):
        read_run(tmp_path / "run")


@pytest.mark.parametrize("text", ["{", "[]", None])
def test_a_folder_without_a_header_is_no_run(tmp_path, text):
    if text is not None:
        (tmp_path / "run.json").write_text(text)
    with pytest.raises(RunError, match=r"run\.json"):
        read_run(tmp_path)


def test_an_existing_run_is_kept_unless_overwritten(tmp_path):
    write_run(tmp_path / "run")
    with pytest.raises(RunError, match="--overwrite"):
        RunWriter(tmp_path / "run", make_header())
    assert len(read_run(tmp_path / "run").rows) == 3
    write_run(tmp_path / "run", views=1, overwrite=True)
    run = read_run(tmp_path / "run")
    assert len(run.rows) == 1
    assert not run.image_path(2).exists()


def test_a_folder_of_the_user_is_never_overwritten(tmp_path):
    precious = tmp_path / "photos" / "holiday.jpg"
    precious.parent.mkdir()
    precious.write_bytes(b"sea")
    with pytest.raises(RunError, match="photos"):
        RunWriter(precious.parent, make_header(), overwrite=True)
    with pytest.raises(RunError, match="holiday"):
        RunWriter(precious, make_header(), overwrite=True)
    assert precious.read_bytes() == b"sea"


def test_nothing_of_the_user_is_overwritten_inside_a_run(tmp_path):
    path = write_run(tmp_path / "run")
    mine = [path / name for name in ("frames/mine.png", "report/mine.png", "models/mine/house.ply")]
    mine += [path / "exports" / "mine.blend", tmp_path / "victim" / "000000.png"]
    for file in mine:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(b"x")
    (path / "models" / "linked").symlink_to(tmp_path / "victim")
    (tmp_path / "victim" / "scene.ply").write_bytes(b"x")
    write_run(path, views=1, overwrite=True)
    assert all(file.read_bytes() == b"x" for file in [*mine, tmp_path / "victim" / "scene.ply"])
    assert len(read_run(path).rows) == 1
    assert not (path / "frames" / "000002.png").exists()


@pytest.mark.parametrize("how", ["resume", "overwrite"])
def test_nothing_is_deleted_or_written_through_a_link(tmp_path, how):
    path = write_run(tmp_path / "run", end=False)
    victim = tmp_path / "victim"
    (victim / "photos").mkdir(parents=True)
    (victim / ".000001.png.0123abcd.partial").write_bytes(b"x")
    (victim / "profile").write_text("mine\n")
    for name, target in (("checkpoints", "."), ("history.jsonl", "profile")):
        if (path / name).is_dir():
            shutil.rmtree(path / name)
        (path / name).unlink(missing_ok=True)
        (path / name).symlink_to(victim / target)
    before = sorted(victim.rglob("*"))
    if how == "resume":
        with pytest.raises(RunError, match="link"):
            RunWriter.resume(path)
    else:
        write_run(path, overwrite=True)
    assert sorted(victim.rglob("*")) == before
    assert (victim / "profile").read_text() == "mine\n"


def test_only_one_of_two_that_begin_a_run_writes_it(tmp_path):
    """Each holds its lock while the other looks; what lies there is the winner's alone."""
    for number in range(30):
        start, path = threading.Barrier(2), tmp_path / str(number)

        def begin(seed, start=start, path=path):
            start.wait()
            try:
                return RunWriter(path, make_header(seed=seed))
            except RunError:
                return None

        with ThreadPoolExecutor(2) as pool:
            writers = list(pool.map(begin, (0, 1)))
        (winner,) = [seed for seed, writer in enumerate(writers) if writer is not None]
        assert read_run(path).header.seed == winner
        writers[winner].close()


@pytest.mark.parametrize("left", [[], ["lock"], ["lock", "frames/", "report/", "trace.jsonl"]])
def test_a_run_that_was_killed_while_it_began_can_begin_again(tmp_path, left):
    for name in left:
        path = tmp_path / "run" / name
        path.parent.mkdir(exist_ok=True)
        path.mkdir() if name.endswith("/") else path.touch()
    assert len(read_run(write_run(tmp_path / "run")).rows) == 3


def test_a_run_without_seals_is_read(tmp_path):
    """As earlier versions wrote them."""
    path = write_run(tmp_path / "run")
    for name in ("run.json", "trace.jsonl"):
        text = (path / name).read_text()
        (path / name).write_text(re.sub(r',\s*"seal": ?"[0-9a-f]{64}"', "", text))
    assert "seal" not in (path / "trace.jsonl").read_text()
    assert len(read_run(path).rows) == 3


def test_a_really_full_disk_keeps_room_for_the_end(tmp_path):
    """On a file system of 2 MB, where a user may mount one."""
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(tmp_path)], capture_output=True
    )
    if mounted.returncode != 0:
        pytest.skip("needs the right to mount a file system")
    try:
        with RunWriter(tmp_path / "run", make_header()) as writer:
            writer.add(*make_view(0))
            with pytest.raises(OSError, match="No space left"):
                (tmp_path / "filler").write_bytes(bytes(4 << 20))
            with pytest.raises(RecordingStopped, match="No space left"):
                writer.add(*make_view(1))
            writer.finish("recording-stopped", "the disk is full")
        run = read_run(tmp_path / "run")
        assert (len(run.rows), run.outcome) == (1, "recording-stopped: the disk is full")
        assert not (tmp_path / "run" / ".room").exists()
    finally:
        subprocess.run(["umount", str(tmp_path)], check=True)


def test_two_writers_cannot_share_a_run(tmp_path):
    with RunWriter(tmp_path / "run", make_header()) as writer:
        writer.add(*make_view(0))
        with pytest.raises(RunError):
            RunWriter(tmp_path / "run", make_header(), overwrite=True)
    assert len(read_run(tmp_path / "run").rows) == 1
    write_run(tmp_path / "run", overwrite=True)  # the lock died with its writer


@pytest.mark.parametrize("failing_call", range(6))
def test_a_full_disk_stops_the_recording_and_spares_what_is_there(
    tmp_path, monkeypatch, failing_call
):
    with RunWriter(tmp_path / "run", make_header()) as writer:
        writer.add(*make_view(0))
        calls = iter(range(1000))
        real_fsync, real_replace = os.fsync, os.replace

        def fail_at(real):
            def call(*args, **handles):
                if next(calls) == failing_call:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                return real(*args, **handles)

            return call

        monkeypatch.setattr(os, "fsync", fail_at(real_fsync))
        monkeypatch.setattr(os, "replace", fail_at(real_replace))
        with pytest.raises(RecordingStopped, match="No space"):
            writer.add(*make_view(1))
        monkeypatch.undo()
        run = read_run(tmp_path / "run")
        assert len(run.rows) == 1
        assert_trees_equal(run.frame(0), make_view(0)[1])
        assert not list((tmp_path / "run" / "frames").glob("*.partial"))
        writer.add(*make_view(1))  # space again: the folder goes on where it was
    assert len(read_run(tmp_path / "run").rows) == 2


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(RunError):
        RunWriter(tmp_path / "file" / "run", make_header())


def test_a_run_without_checkpoint_says_so(tmp_path):
    run = read_run(write_run(tmp_path / "run"))
    with pytest.raises(RunError):
        run.checkpoint()
