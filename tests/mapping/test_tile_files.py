"""Tiles on disk: the same bits, deleted when nobody needs them, refused when they are damaged."""

import gc
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.errors import PathError
from r3jax.mapping.tile_files import (
    Rows,
    Voxels,
    open_tile_folder,
    packed_rows,
    read_tiles,
    remove_other_tiles,
    unpacked_rows,
    write_tiles,
)

NAMES = ("box", "place", "visited", "count", "mean", "m2", "resolution", "misses")


def rows_of(num: int, seed: int, *, misses: bool = True, words: int = 2) -> Rows:
    """Any bits, also those of NaN and of -0."""
    rng = np.random.default_rng(seed)
    bits = lambda *shape: rng.integers(0, 1 << 32, shape, np.uint32)
    return Rows(
        box=rng.integers(-(1 << 20), 1 << 20, (2, 3)),
        place=np.sort(rng.integers(0, 1 << 17, num)).astype(np.uint32),
        visited=bits(words, num),
        count=rng.integers(0, 256, num).astype(np.uint8 if seed % 2 else np.float32),
        mean=bits(3, num).view(np.float32),
        m2=bits(num).view(np.float32),
        resolution=bits(num).view(np.float32),
        misses=rng.integers(0, 9, num).astype(np.uint8) if misses else None,
    )


def assert_same_bits(a: Rows, b: Rows) -> None:
    for name in NAMES:
        x, y = getattr(a, name), getattr(b, name)
        assert (x is None) == (y is None), name
        if x is not None:
            assert (x.dtype, x.shape, x.tobytes()) == (y.dtype, y.shape, y.tobytes()), name


def files_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.rglob("*.tile"))


@given(st.integers(1, 300), st.integers(0, 99), st.booleans(), st.integers(1, 17))
def test_packing_loses_no_bit(num, seed, misses, words):
    rows = rows_of(num, seed, misses=misses, words=words)
    assert_same_bits(unpacked_rows(packed_rows(rows)), rows)


def test_the_farthest_tiles_go_to_disk_and_come_back_as_they_were(tmp_path):
    folder = open_tile_folder(tmp_path, 2.5 * rows_of(100, 1).nbytes)
    every = {(x, 0, 0): rows_of(100, 2 * x + 1) for x in range(5)}
    voxels = folder.fit(Voxels(every), (0, 0, 0))
    assert sorted(voxels.disk) == [(2, 0, 0), (3, 0, 0), (4, 0, 0)]
    assert voxels.nbytes <= folder.most_bytes
    assert (len(voxels), voxels.num_voxels) == (5, 500)
    for tile, rows in voxels.items():
        assert_same_bits(rows, every[tile])


def test_a_file_lives_as_long_as_somebody_uses_it(tmp_path):
    folder = open_tile_folder(tmp_path, 0)
    one = folder.fit(Voxels({(0, 0, 0): rows_of(9, 1)}), (0, 0, 0))
    both = folder.fit(one.changed((), {(1, 0, 0): rows_of(9, 2)}), (0, 0, 0))
    assert len(files_in(tmp_path)) == 2
    del both
    gc.collect()
    assert len(files_in(tmp_path)) == 1
    assert len(one[0, 0, 0].place) == 9
    del one, folder
    gc.collect()
    assert [path.name for path in tmp_path.iterdir() if path.name != ".r3jax"] == ["lock"]


@pytest.mark.parametrize("harm", ["deleted", "cut", "changed", "empty", "folder"])
def test_damage_is_refused_with_the_file_and_the_remedy(tmp_path, harm):
    folder = open_tile_folder(tmp_path, 0)
    voxels = folder.fit(Voxels({(3, 0, 0): rows_of(99, 1)}), (0, 0, 0))
    path = voxels.disk[3, 0, 0].path
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.unlink()
    if harm == "folder":
        path.mkdir()
    elif harm != "deleted":
        path.write_bytes({"cut": data[:-9], "changed": data, "empty": b""}[harm])
    with pytest.raises(PathError, match=rf"{path.name}.*r3jax\.rebuild"):
        voxels[3, 0, 0]


def test_a_folder_that_cannot_be_used_is_refused(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("words")
    (tmp_path / "file").write_text("words")
    for name, match in (("mine", "thesis|not a tile-folder"), ("file/in", "tile_folder")):
        with pytest.raises(PathError, match=match):
            open_tile_folder(tmp_path / name, 0)
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["thesis.txt"]


def test_a_full_disk_is_refused_and_nothing_is_lost(tmp_path):
    """On a file system of one megabyte; the same call succeeds once there is room."""
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(tmp_path)], capture_output=True
    )
    if mounted.returncode:
        pytest.skip("no permission to mount")
    try:
        folder = open_tile_folder(tmp_path, 0)
        other = tmp_path / "other"
        other.write_bytes(bytes(900_000))
        voxels = Voxels({(0, 0, 0): rows_of(9000, 1)})
        with pytest.raises(PathError, match=r"No space left on device.*free some space"):
            folder.fit(voxels, (0, 0, 0))
        assert files_in(tmp_path) == []
        other.unlink()
        assert_same_bits(folder.fit(voxels, (0, 0, 0))[0, 0, 0], voxels[0, 0, 0])
        del folder
        gc.collect()
    finally:
        subprocess.run(["umount", "-l", str(tmp_path)], check=True)


PROCESS = """
import sys
from tests.mapping.test_tile_files import Voxels, assert_same_bits, open_tile_folder, rows_of
folder = open_tile_folder(sys.argv[1], 0)
seeds = range(int(sys.argv[2]), int(sys.argv[2]) + 40)
voxels = folder.fit(Voxels({(s, 0, 0): rows_of(50, s) for s in seeds}), (0, 0, 0))
print("written", flush=True)
sys.stdin.readline()
for s in seeds:
    assert_same_bits(voxels[s, 0, 0], rows_of(50, s))
print("the same", flush=True)
"""


def process(folder: Path, seed: int) -> subprocess.Popen:
    words = [sys.executable, "-c", PROCESS, str(folder), str(seed)]
    return subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def test_processes_share_a_folder_and_the_next_one_cleans_up_after_a_killed_one(tmp_path):
    (kept := tmp_path / "t" / "process-notes").mkdir(parents=True)
    (kept / "mine.tile").touch()
    first, second = process(tmp_path / "t", 0), process(tmp_path / "t", 100)
    assert [p.stdout.readline() for p in (first, second)] == ["written\n"] * 2
    assert len(files_in(tmp_path)) == 81
    first.kill()
    first.communicate()
    folder = open_tile_folder(tmp_path / "t", 0)
    assert len(files_in(tmp_path)) == 41
    assert second.communicate("go on\n") == ("the same\n", None)
    assert second.returncode == 0
    assert files_in(tmp_path) == ["mine.tile"]
    assert folder.own.is_dir()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning", "ignore:.*fork:RuntimeWarning")
def test_a_fork_of_the_process_deletes_nothing(tmp_path):
    folder = open_tile_folder(tmp_path, 0)
    voxels = folder.fit(Voxels({(0, 0, 0): rows_of(9, 1)}), (0, 0, 0))
    child = os.fork()
    if not child:
        del voxels, folder
        gc.collect()
        os._exit(0)
    os.waitpid(child, 0)
    assert_same_bits(voxels[0, 0, 0], rows_of(9, 1))


def test_stored_tiles_are_written_once_and_read_into_memory_or_a_folder(tmp_path):
    scratch = open_tile_folder(tmp_path / "scratch", 0)
    there = scratch.fit(Voxels({(9, 0, 0): rows_of(50, 9)}), (0, 0, 0))
    voxels = there.changed((), {(x, 0, 0): rows_of(50, x) for x in range(3)})
    store = tmp_path / "saved" / "tiles"
    listed = write_tiles(voxels, store)
    before = {path: path.stat().st_mtime_ns for path in store.iterdir()}
    (damaged := min(before)).write_bytes(b"")
    write_tiles(voxels.changed([(9, 0, 0)], {}), store)
    assert {p for p in before if p.stat().st_mtime_ns != before[p]} <= {damaged}
    listed = write_tiles(voxels, store)
    most = 1.5 * rows_of(50, 1).nbytes
    for into in (None, open_tile_folder(tmp_path / "other", most)):
        again = read_tiles(store, listed, into, (0, 0, 0))
        assert set(again) == set(voxels)
        assert (into is None) == (not again.disk)
        assert into is None or again.nbytes <= most
        for tile in voxels:
            assert_same_bits(again[tile], voxels[tile])
    fewer = write_tiles(Voxels({(0, 0, 0): rows_of(50, 0)}), store)
    (store / "mine.tile").touch()
    remove_other_tiles(store, fewer)
    assert len(list(store.iterdir())) == 2
    with pytest.raises(PathError, match=r"tiles.*r3jax\.rebuild"):
        read_tiles(store, listed, None, (0, 0, 0))


def test_what_is_no_tile_is_not_read():
    with pytest.raises(ValueError, match="tile"):
        unpacked_rows(b"something else")
