"""Bags that are being recorded: cut anywhere, they show what is whole, and the rest as it comes."""

from contextlib import suppress
from itertools import pairwise

import numpy as np
import pytest

from r3jax.formats.errors import FormatError
from r3jax.formats.ros.bag_reader import read_bag
from r3jax.formats.ros.bags import MAX_CHUNK, unpack_chunk
from r3jax.formats.ros.growing import FollowedBag, McapFollower, growing_files, key_frames
from r3jax.validation.errors import ForeignFileError
from tests.formats.bags import Robot, camera_poses, moved, write_bag
from tests.formats.phones import NUM


def bag_file(tmp_path, pose="tf"):
    return next(write_bag(tmp_path / "whole", Robot(pose=pose)).glob("*.mcap"))


def names(images):
    return [path.name for path in images.image_paths]


def followed(path):
    files = growing_files(path)
    return FollowedBag(path), files


def test_a_bag_without_its_end_shows_the_same(tmp_path):
    whole = bag_file(tmp_path)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[:-600])  # the summary
    bag, files = followed(cut)
    images, expected = bag.images(files), read_bag(whole)
    assert names(images) == names(expected)
    np.testing.assert_allclose(images.poses, camera_poses(), atol=1e-6)
    for index in range(NUM):
        np.testing.assert_array_equal(images.rgb(index), expected.rgb(index))
        np.testing.assert_array_equal(images.depth(index), expected.depth(index))


@pytest.mark.parametrize("pose", ["tf", "odometry"])
def test_a_bag_that_grows_byte_by_byte_only_gains_frames(tmp_path, pose, monkeypatch):
    monkeypatch.setattr("r3jax.formats.ros.growing._SETTLE", 0)
    whole = bag_file(tmp_path, pose)
    content = whole.read_bytes()
    growing = tmp_path / "growing.mcap"
    growing.touch()
    bag, files = followed(growing)
    seen: list[list[str]] = []
    for end in np.linspace(0, len(content), 40).astype(int):
        growing.write_bytes(content[:end])
        if not seen:
            with suppress(FormatError):
                seen.append(names(bag.images(files)))
            continue
        images = bag.images(files)  # once there is a frame, it stays
        assert np.abs(images.poses - camera_poses()[: len(images)]).max() < 1e-6
        seen.append(names(images))
    for before, after in pairwise(seen):
        assert after[: len(before)] == before
    assert seen[-1] == names(read_bag(whole))


def test_a_folder_that_is_recorded_gets_more_parts(tmp_path):
    whole = bag_file(tmp_path)
    path = tmp_path / "drive"
    path.mkdir()
    assert growing_files(path) == []
    for number in (0, 2, 10):
        (path / f"drive_{number}.mcap").write_bytes(b"")
    assert [file.name for file in growing_files(path)] == [
        "drive_0.mcap", "drive_2.mcap", "drive_10.mcap",
    ]  # fmt: skip
    (path / "drive_2.mcap").write_bytes(whole.read_bytes())
    bag, files = followed(path)
    assert len(bag.images(files)) == NUM


def test_sqlite_is_refused_until_the_bag_is_finished(tmp_path):
    path = write_bag(tmp_path / "drive", kind="db3")
    assert growing_files(path) == []  # has its metadata.yaml: read like any other
    (path / "metadata.yaml").unlink()
    with pytest.raises(FormatError, match="--storage mcap"):
        growing_files(path)


def test_a_bag_of_ros_1_is_refused_until_it_is_closed(tmp_path):
    active = tmp_path / "drive.bag.active"
    active.touch()
    for path in (active, tmp_path / "drive.bag", tmp_path):
        with pytest.raises(FormatError, match=f"{path}"):
            growing_files(path)


def test_frames_are_half_a_second_apart_and_moved():
    stamps = np.arange(0, 4_000_000_000, 100_000_000)
    poses = np.stack([moved(0.2 * i, 0.0, 0.0) for i in range(len(stamps))])
    assert key_frames(stamps, poses, 2_200_000_000).tolist() == [0, 5, 10, 15, 20]
    poses[6:30] = poses[5]
    assert key_frames(stamps, poses, 4_000_000_000).tolist() == [0, 5, 30, 35]
    turned = poses.copy()
    turned[:] = np.eye(4)
    turned[10:] = moved(0.0, 0.0, 0.0, yaw=0.2)
    assert key_frames(stamps, turned, 4_000_000_000).tolist() == [0, 10]
    assert key_frames(stamps, poses, -1).tolist() == []


def test_other_files_are_refused(tmp_path):
    (tmp_path / "none.mcap").write_bytes(bytes(100))
    with pytest.raises(ForeignFileError, match="no MCAP"):
        McapFollower(tmp_path / "none.mcap").advance()


@pytest.mark.parametrize("compression", ["bz2", "lz4", "zstd"])
def test_a_chunk_that_says_less_than_it_holds_is_refused(compression):
    import bz2

    import lz4.frame
    from backports import zstd

    pack = {"bz2": bz2.compress, "lz4": lz4.frame.compress, "zstd": zstd.compress}[compression]
    content = bytes(1 << 20)
    assert unpack_chunk(pack(content), compression, len(content)) == content
    assert unpack_chunk(pack(content), compression) == content
    for size in (1000, (1 << 20) + 1):
        with pytest.raises(ForeignFileError):
            unpack_chunk(pack(content), compression, size)
    with pytest.raises(ForeignFileError):
        unpack_chunk(pack(content), compression, MAX_CHUNK + 1)
    with pytest.raises(ForeignFileError):
        unpack_chunk(b"nothing of the kind", compression, 100)


def test_a_bomb_in_a_bag_is_refused(tmp_path, monkeypatch):
    path = write_bag(tmp_path / "whole")
    monkeypatch.setattr("r3jax.formats.ros.bags.MAX_CHUNK", 1000)
    with pytest.raises(FormatError, match="1000"):
        read_bag(path)
    monkeypatch.setattr("r3jax.formats.ros.growing._SETTLE", 0)
    bag, files = followed(path)
    with pytest.raises(FormatError, match="1000"):
        bag.images(files)
