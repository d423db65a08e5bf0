"""A capture that another program is writing: frames come half, late, in any order, or corrected."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from r3jax.apps.audit.live import growing
from r3jax.apps.audit.live.growing import GrowingCapture
from r3jax.formats.nerfstudio import OPENGL_FROM_OPENCV
from tests.apps.audit.room import picture, round_poses, write_nerfstudio, write_recording
from tests.formats.bags import camera_poses, write_bag

POSES = round_poses(6)


class Writer:
    """Writes a recording into a folder, file by file."""

    def __init__(self, folder):
        self.whole = write_recording(folder / "whole", POSES)
        self.path = folder / "growing"
        for name in ("images", "depth"):
            (self.path / name).mkdir(parents=True)
        shutil.copy(self.whole / "K.txt", self.path)
        self.poses("")

    def file(self, kind: str, number: int, part: float = 1.0) -> None:
        name = f"{kind}/{number:03d}.png"
        content = (self.whole / name).read_bytes()
        (self.path / name).write_bytes(content[: int(part * len(content))])

    def poses(self, text: str) -> None:
        (self.path / "poses.txt").write_text(text)

    def lines(self, *numbers: int) -> str:
        lines = (self.whole / "poses.txt").read_text().splitlines()
        return "".join(f"{lines[number]}\n" for number in numbers)


@pytest.fixture
def writer(tmp_path):
    return Writer(tmp_path)


@pytest.fixture
def capture(writer, tmp_path):
    return GrowingCapture(writer.path, tmp_path / "scratch")


def names(capture) -> list[str]:
    return [arrival.name for arrival in capture.look()[1]]


def state_of(folder):
    return {p: (p.stat().st_mtime_ns, p.stat().st_size) for p in sorted(folder.rglob("*"))}


def test_a_frame_counts_once_all_of_it_is_there(writer, capture):
    assert names(capture) == []
    writer.file("images", 0)
    assert names(capture) == []
    writer.file("depth", 0)
    assert names(capture) == []
    writer.poses(writer.lines(0)[:30])
    assert names(capture) == []
    writer.poses(writer.lines(0))
    before = state_of(writer.path)
    assert names(capture) == ["000.png"]
    assert names(capture) == []
    assert state_of(writer.path) == before


def test_a_folder_that_is_full_already_comes_in_by_and_by(writer, capture, monkeypatch):
    monkeypatch.setattr(growing, "_BATCH", 4)
    for number in range(6):
        writer.file("images", number)
        writer.file("depth", number)
    writer.poses(writer.lines(*range(6)))
    assert [names(capture), names(capture), names(capture)] == [
        ["000.png", "001.png", "002.png", "003.png"],
        ["004.png", "005.png"],
        [],
    ]


def test_half_a_picture_is_waited_for_and_others_go_on(writer, capture):
    for number in (0, 1, 2):
        writer.file("images", number, 0.5 if number == 1 else 1.0)
        writer.file("depth", number)
    writer.poses(writer.lines(0, 1, 2))
    assert names(capture) == ["000.png", "002.png"]
    assert "001.png" in capture.waiting_for
    writer.file("images", 1)
    assert names(capture) == ["001.png"]
    assert capture.source is not None
    assert capture.source.labels == ("000.png", "001.png", "002.png")
    for index in range(3):
        assert np.array_equal(capture.source.read(index)[0], picture(POSES[index])[0])


def test_a_frame_that_is_late_does_not_take_the_next_one_s_pose(writer, capture):
    for number in (0, 1, 3):
        writer.file("images", number)
        writer.file("depth", number)
    writer.poses(writer.lines(0, 1, 2, 3))
    assert names(capture) == ["000.png", "001.png"]
    writer.file("images", 2)
    writer.file("depth", 2)
    source, arrivals, has_moved = capture.look()
    assert [arrival.name for arrival in arrivals] == ["002.png", "003.png"]
    assert not has_moved
    np.testing.assert_allclose(source.poses, POSES[:4], atol=1e-9)


def test_poses_that_are_corrected_are_noticed(writer, capture):
    for number in (0, 1):
        writer.file("images", number)
        writer.file("depth", number)
    writer.poses(writer.lines(0, 1))
    assert len(names(capture)) == 2
    writer.poses(writer.lines(0, 2))  # a loop was closed
    source, arrivals, has_moved = capture.look()
    assert arrivals == []
    assert has_moved
    assert [arrival.name for arrival in capture.again(source)] == ["000.png", "001.png"]
    assert not capture.look()[2]


def test_a_transforms_json_that_is_half_written_is_read_again(tmp_path):
    path = write_nerfstudio(tmp_path / "growing", POSES, depth=True)
    whole = json.loads((path / "transforms.json").read_text())
    capture = GrowingCapture(path, tmp_path / "scratch")
    text = json.dumps({**whole, "frames": whole["frames"][:3]})
    (path / "transforms.json").write_text(text[:200])
    assert names(capture) == []
    assert capture.waiting_for
    (path / "transforms.json").write_text(text)
    assert names(capture) == ["000.png", "001.png", "002.png"]
    shuffled = [whole["frames"][i] for i in (5, 0, 1, 2)]
    (path / "transforms.json").write_text(json.dumps({**whole, "frames": shuffled}))
    source, arrivals, has_moved = capture.look()
    assert [(arrival.name, arrival.index) for arrival in arrivals] == [("005.png", 0)]
    assert not has_moved
    expected = np.array(shuffled[0]["transform_matrix"]) @ OPENGL_FROM_OPENCV
    np.testing.assert_allclose(source.poses[0], expected, atol=1e-9)


def test_numbered_frames_come_in_as_they_are_whole(tmp_path):
    path = tmp_path / "growing"
    path.mkdir()
    capture = GrowingCapture(path, tmp_path / "scratch")
    for number in (0, 2, 1):
        base = path / f"frame-{number:06d}"
        rgb = np.full((480, 640, 3), 10 * number, np.uint8)
        Image.fromarray(rgb).save(f"{base}.color.png")
        assert names(capture) == []
        Image.fromarray(np.full((480, 640), 1500, np.uint16)).save(f"{base}.depth.png")
        np.savetxt(f"{base}.pose.txt", POSES[number])
        assert names(capture) == [f"frame-{number:06d}.color.png"]


def test_without_depth_images_there_is_no_guidance(tmp_path):
    path = write_nerfstudio(tmp_path / "bare", POSES, depth=False)
    with pytest.raises(ValueError, match="depth"):
        GrowingCapture(path, tmp_path / "scratch").look()


def test_a_bag_that_is_recorded_comes_in_by_and_by(tmp_path, monkeypatch):
    monkeypatch.setattr("r3jax.formats.ros.growing._SETTLE", 0)
    content = next(write_bag(tmp_path / "whole").glob("*.mcap")).read_bytes()
    path = tmp_path / "drive"
    capture = GrowingCapture(path, tmp_path / "scratch")
    assert names(capture) == []
    path.mkdir()
    found: list[str] = []
    for end in np.linspace(0, len(content), 6).astype(int):
        (path / "drive_0.mcap").write_bytes(content[:end])
        source, arrivals, has_moved = capture.look()
        found += [arrival.name for arrival in arrivals]
        assert not has_moved
    assert len(found) == len(set(found)) == len(camera_poses())
    assert source.name == "drive"
    before = state_of(path)
    assert len(list(capture.again(source))) == len(found)
    assert state_of(path) == before


def test_a_bag_that_cannot_be_followed_ends_it(tmp_path):
    (tmp_path / "drive.db3").touch()
    with pytest.raises(ValueError, match="mcap"):
        GrowingCapture(tmp_path, tmp_path / "scratch").look()
