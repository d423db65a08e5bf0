"""Checkpoints: what goes in comes out, one at a time, and what a kill or a full disk leaves."""

import os
import shutil
import subprocess
import sys
import threading

import numpy as np
import orbax.checkpoint as ocp
import pytest

from r3jax.runs.header import RunError
from r3jax.runs.stored_states import (
    KEPT,
    CheckpointWriter,
    checkpoint_steps,
    fill,
    load_checkpoint,
    named_arrays,
)

TABLES = {
    "loop": {"seconds": np.asarray(1 / 3), "views": np.asarray(7), "is_lost": np.asarray(True)},
    "map": {"key": np.arange(6, dtype=np.uint32).reshape(2, 3)},
    "policy": {"memory.taken": np.zeros((0, 3), np.float32), "memory.0": np.ones(4, np.float32)},
    "nothing": {},
}


def test_arrays_come_back_with_type_and_shape(tmp_path):
    writer = CheckpointWriter(tmp_path / "c")
    writer.save(3, TABLES, wait=True)
    writer.close()
    tables = load_checkpoint(tmp_path / "c", 3)
    assert set(tables) == {"loop", "map", "policy"}
    for table, arrays in tables.items():
        assert arrays.keys() == TABLES[table].keys()
        for name, array in arrays.items():
            expected = np.asarray(TABLES[table][name])
            assert (array.dtype, array.shape) == (expected.dtype, expected.shape), name
            np.testing.assert_array_equal(array, expected)


def test_the_newest_three_are_kept(tmp_path):
    writer = CheckpointWriter(tmp_path / "c")
    for step in range(5):
        assert writer.save(step, TABLES, wait=True)
    writer.close()
    assert sorted(p.name for p in (tmp_path / "c").iterdir()) == ["000002", "000003", "000004"]


def test_a_slow_disk_leaves_checkpoints_out_but_not_the_last(tmp_path, monkeypatch):
    go_on, save = threading.Event(), ocp.PyTreeCheckpointer.save

    def slow(self, *args, **kwargs):
        assert go_on.wait(30.0)
        return save(self, *args, **kwargs)

    monkeypatch.setattr(ocp.PyTreeCheckpointer, "save", slow)
    writer = CheckpointWriter(tmp_path / "c")
    assert writer.save(0, TABLES)
    assert not writer.save(1, TABLES)  # view 0 is still under way: the mission is not held up
    go_on.set()
    assert writer.save(2, TABLES, wait=True)
    writer.close()
    assert checkpoint_steps(tmp_path / "c") == [0, 2]


def test_a_deletion_that_was_cut_off_is_ended(tmp_path):
    writer = CheckpointWriter(tmp_path / "c")
    for step in (0, 1):
        writer.save(step, TABLES, wait=True)
    writer.close()
    (tmp_path / "c" / "000000" / "_CHECKPOINT_METADATA").unlink()
    CheckpointWriter(tmp_path / "c").close()
    assert [p.name for p in (tmp_path / "c").iterdir()] == ["000001"]


def test_what_the_user_keeps_in_a_checkpoint_survives_it(tmp_path):
    folder = tmp_path / "c"
    writer = CheckpointWriter(folder)
    writer.save(0, TABLES, wait=True)
    (folder / "000000" / "mine").write_bytes(b"x")
    (folder / "000000" / "d" / "mine").write_bytes(b"x")
    for step in range(1, KEPT + 1):
        writer.save(step, TABLES, wait=True)
    writer.close()
    assert checkpoint_steps(folder) == [1, 2, 3]
    left = {p.relative_to(folder / "000000").as_posix() for p in (folder / "000000").rglob("*")}
    assert left == {"mine", "d", "d/mine"}


def test_a_link_under_a_temporary_name_is_not_written_through(tmp_path):
    """What led to the loss of a folder: names that can be foreseen."""
    (tmp_path / "victim").mkdir()
    (tmp_path / "victim" / "mine").write_bytes(b"x")
    folder = tmp_path / "c"
    folder.mkdir()
    (folder / ".writing-000000").symlink_to(tmp_path / "victim")
    (folder / "000000.orbax-checkpoint-tmp").symlink_to(tmp_path / "victim")
    writer = CheckpointWriter(folder)
    writer.save(0, TABLES, wait=True)
    writer.close()
    assert checkpoint_steps(folder) == [0]
    assert [p.name for p in (tmp_path / "victim").iterdir()] == ["mine"]


def test_nothing_of_the_user_is_deleted(tmp_path):
    folder = tmp_path / "c"
    kept = ["photos", ".ssh", "2019", "000123", "000007.old", ".discarded-letters"]
    for name in kept:
        (folder / name).mkdir(parents=True)
        (folder / name / "mine").write_bytes(b"x")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "mine").write_bytes(b"x")
    (folder / "000124").symlink_to(tmp_path / "elsewhere")
    (folder / ".discarded-000125").symlink_to(tmp_path / "elsewhere")
    writer = CheckpointWriter(folder)
    for step in range(KEPT + 2):
        writer.save(step, TABLES, wait=True)
    writer.close()
    assert checkpoint_steps(folder) == [2, 3, 4]
    assert all((folder / name / "mine").exists() for name in kept)
    assert (tmp_path / "elsewhere" / "mine").exists()


def test_what_is_no_checkpoint_is_not_written_over(tmp_path):
    folder = tmp_path / "c"
    (folder / "000000").mkdir(parents=True)
    (folder / "000000" / "mine").write_bytes(b"x")
    writer = CheckpointWriter(folder)
    with pytest.raises(OSError, match="000000"):
        writer.save(0, TABLES, wait=True)
    writer.close()
    assert (folder / "000000" / "mine").exists()


def test_a_folder_that_is_a_link_is_refused(tmp_path):
    (tmp_path / "victim" / "photos").mkdir(parents=True)
    (tmp_path / "c").symlink_to(tmp_path / "victim")
    with pytest.raises(OSError, match="link"):
        CheckpointWriter(tmp_path / "c")
    assert (tmp_path / "victim" / "photos").exists()


def test_a_checkpoint_without_hashes_is_read(tmp_path):
    """As earlier versions wrote them."""
    with ocp.PyTreeCheckpointer() as checkpointer:
        checkpointer.save(tmp_path / "000000", {"map": {"key": np.arange(3)}})
    assert checkpoint_steps(tmp_path) == [0]
    np.testing.assert_array_equal(load_checkpoint(tmp_path, 0)["map"]["key"], np.arange(3))


def test_a_refused_write_is_told_at_the_next_call(tmp_path, monkeypatch):
    def full(self, *args, **kwargs):
        raise ValueError("RESOURCE_EXHAUSTED: No space left on device")

    monkeypatch.setattr(ocp.PyTreeCheckpointer, "save", full)
    writer = CheckpointWriter(tmp_path / "c")
    writer.save(0, TABLES)
    with pytest.raises(OSError, match="000000"):
        writer.wait()
    writer.close()


@pytest.mark.parametrize("how", ["missing", "empty", "a pipe", "no tables"])
def test_a_damaged_checkpoint_is_named(tmp_path, how):
    writer = CheckpointWriter(tmp_path)
    writer.save(0, TABLES, wait=True)
    writer.close()
    if how == "missing":
        shutil.rmtree(tmp_path / "000000")
    elif how == "empty":
        for file in (p for p in (tmp_path / "000000").rglob("*") if p.is_file()):
            file.write_bytes(b"")
    elif how == "a pipe":  # Orbax would wait for ever for what comes out of it
        found = next(p for p in (tmp_path / "000000").rglob("*") if p.is_file())
        found.unlink()
        os.mkfifo(found)
    else:
        with ocp.PyTreeCheckpointer() as checkpointer:
            checkpointer.save(tmp_path / "000000", {"a": np.ones(3)}, force=True)
    with pytest.raises(RunError, match="000000"):
        load_checkpoint(tmp_path, 0)


def test_a_tree_is_filled_with_what_it_is_made_of():
    tree = {"a": 3, "b": (np.zeros(2), True, 2.5), "c": None, "d": []}
    arrays = named_arrays(tree)
    assert sorted(arrays) == ["a", "b.0", "b.1", "b.2"]
    back = fill(tree, arrays)
    assert back["a"] == 3
    assert type(back["a"]) is int
    assert type(back["b"][1]) is bool
    assert back["c"] is None
    grown = fill(tree, arrays | {"b.0": np.arange(5.0)})
    np.testing.assert_array_equal(grown["b"][0], np.arange(5.0))
    with pytest.raises(ValueError, match=r"b\.0"):
        fill(tree, arrays | {"b.0": np.zeros((2, 2))})
    with pytest.raises(ValueError, match="a, e"):
        fill(tree, {k: v for k, v in arrays.items() if k != "a"} | {"e": np.zeros(1)})


def test_a_really_full_disk_is_reported(tmp_path):
    """On a file system of 1 MB, where a user may mount one."""
    program = (
        "import sys, numpy as np\nfrom pathlib import Path\n"
        "from r3jax.runs.stored_states import CheckpointWriter\n"
        "noise = np.random.default_rng(0).integers(0, 256, 500_000, np.uint8)\n"
        "writer = CheckpointWriter(Path(sys.argv[1]))\n"
        "try:\n    writer.save(0, {'map': {f'noise{i}': noise + i for i in range(8)}}, wait=True)\n"
        "except OSError as error:\n    print('refused:', error)\n"
        "writer.close()\n"
    )
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(tmp_path)], capture_output=True
    )
    if mounted.returncode != 0:
        pytest.skip("needs the right to mount a file system")
    try:
        done = subprocess.run(
            [sys.executable, "-c", program, str(tmp_path / "c")], capture_output=True, text=True
        )
        assert "No space left on device" in done.stdout, done.stderr
        assert done.stdout.count("\n") == 1
        assert "orbax" not in done.stderr  # no pages of its log
        assert done.stderr.count("Traceback") <= 1  # one may come while the process ends
        assert not list((tmp_path / "c").iterdir())
    finally:
        subprocess.run(["umount", str(tmp_path)], check=True)
