"""Exports of phone apps: what they show lies where the room has its walls."""

import json
import sys
import time

import numpy as np
import pytest

from r3jax.captures.source import source_of
from r3jax.formats.captures import open_capture
from r3jax.formats.errors import FormatError
from r3jax.formats.phones import archives
from r3jax.formats.phones.polycam import is_polycam, read_polycam
from r3jax.formats.phones.record3d import read_record3d
from r3jax.formats.phones.stray_scanner import read_stray_scanner
from r3jax.formats.posed_images import PosedImages
from r3jax.formats.video import Video
from tests.apps.audit.room import SIZE, color_of
from tests.formats import phones
from tests.formats.phones import FACTOR, NUM, Y_UP_FROM_Z_UP, rays_of
from tests.fuzz.mutations import zipped
from tests.fuzz.tree import lay_out

JPEG = 12.0
"""Mean error of colors that a JPEG of so small an image may have [of 255]."""


def assert_shows_the_room(images: PosedImages, T_capture_room: np.ndarray, colors: float = JPEG):
    """Pixels whose center is that of a depth pixel are points on the walls, of the wall's color."""
    measured = 0
    for index in range(len(images)):
        frame, middle = images.frame(index), slice(FACTOR // 2, None, FACTOR)
        rays, depth = rays_of(images.lenses[index])[middle, middle], np.asarray(frame.depth)
        z = depth[middle, middle].astype(np.float64)
        local = (z[..., None] * rays)[z > 0]
        pose = np.linalg.inv(T_capture_room) @ images.poses[index]
        points = local @ pose[:3, :3].T + pose[:3, 3]
        to_wall = np.minimum(np.abs(points), np.abs(SIZE - points)).min(axis=1)
        assert to_wall.max() < 2e-3  # depth comes in millimeters
        assert (points > -2e-3).all()
        assert (points < SIZE + 2e-3).all()
        shown = np.asarray(frame.rgb)[middle, middle][z > 0]
        assert 255 * np.abs(shown - color_of(points)).mean() < colors
        measured += (z > 0).sum()
    assert measured > 0.5 * len(images) * z.size


def write_zip(path, files):
    path.write_bytes(zipped(files))
    return path


@pytest.fixture(params=["folder", "zip", "zip with a top folder"])
def polycam(request, tmp_path):
    if request.param == "folder":
        lay_out(tmp_path / "scan", phones.polycam())
        return tmp_path / "scan"
    top = "MyScan/" if "top" in request.param else ""
    files = {"__MACOSX/keyframes/._x": b"", **phones.polycam(top=top)}
    return write_zip(tmp_path / "scan.zip", files)


def test_polycam_shows_the_room_by_its_corrected_cameras(polycam):
    images = read_polycam(polycam)
    assert len(images) == NUM
    assert images.remark is None
    assert_shows_the_room(images, Y_UP_FROM_Z_UP)
    assert [lens.params[0] for lens in images.lenses] == [33.0, 34.0, 35.0, 36.0]


def test_a_polycam_archive_is_opened_by_its_looks_and_named_after_itself(polycam):
    capture = open_capture(polycam)
    assert capture.name == "scan"
    assert len(capture) == NUM
    source = source_of(capture.source, capture.name)
    np.testing.assert_array_equal(source.up, [0, 1, 0])  # one camera lies on its side
    assert source.labels[0] == "1600000.jpg"


def test_polycam_without_corrected_cameras_has_its_own(tmp_path):
    lay_out(tmp_path, phones.polycam(corrected=False))
    assert_shows_the_room(read_polycam(tmp_path), Y_UP_FROM_Z_UP)


def test_unsure_and_far_depth_of_polycam_is_no_measurement(tmp_path):
    files = phones.polycam()
    name = "keyframes/depth/1600000.png"
    far = phones.depth_steps(phones.room_poses()[0], phones.smaller(phones.lens_of(0)))
    far[5, 5] = 5001
    lay_out(tmp_path, files | {name: phones.encoded(far)})
    depth = read_polycam(tmp_path).depth(0)
    assert depth is not None
    blocks = depth.reshape(12, FACTOR, 16, FACTOR)
    assert (blocks[:, :, -2:] == 0).all()
    assert (blocks[0, :, 0] == 0).all()
    assert (blocks[5, :, 5] == 0).all()
    assert (blocks[1:5, :, :-2] > 0).all()
    without = {n: data for n, data in files.items() if "confidence" not in n}
    lay_out(tmp_path, without)
    assert (read_polycam(tmp_path).depth(0).reshape(12, FACTOR, 16, FACTOR)[:, :, -2:] > 0).all()


def test_frames_without_depth_are_left_out_and_counted(tmp_path):
    files = phones.polycam()
    del files["keyframes/depth/2300000.png"]
    lay_out(tmp_path, files)
    images = read_polycam(tmp_path)
    assert len(images) == NUM - 1
    assert images.remark == (
        "1 of 4 frames without an image, depth or a pose are left out."
    )  # fmt: skip


def test_other_folders_are_no_polycam(tmp_path):
    lay_out(tmp_path / "scan", {"images/0.jpg": b""})
    write_zip(tmp_path / "scan.zip", {"images/0.jpg": b""})
    for name in ("scan", "scan.zip", "nowhere", "nowhere.zip"):
        assert not is_polycam(tmp_path / name)


def test_an_archive_that_was_cut_off_says_so(tmp_path):
    path = tmp_path / "scan.zip"
    path.write_bytes(zipped(phones.polycam())[:-100])
    with pytest.raises(FormatError, match=r"scan\.zip"):
        open_capture(path)


def test_an_archive_of_many_folders_is_refused_at_once(tmp_path, monkeypatch):
    """Each was compared with each: 8,000 took 45 s."""
    path = write_zip(tmp_path / "many.zip", {f"d{i}/a.txt": b"" for i in range(8000)})
    begun = time.process_time()
    with pytest.raises(FormatError, match=r"many\.zip"):
        open_capture(path)
    assert time.process_time() - begun < 5.0
    monkeypatch.setattr(archives, "_MAX_MEMBERS", 7999)
    with pytest.raises(FormatError, match="8,000 files"):
        open_capture(path)


def test_a_member_that_was_damaged_says_so(tmp_path):
    data = bytearray(zipped(phones.polycam()))
    at = data.find(b"keyframes/depth/1600000.png") + 60
    data[at : at + 20] = bytes(20)
    (tmp_path / "scan.zip").write_bytes(data)
    images = read_polycam(tmp_path / "scan.zip")
    with pytest.raises(FormatError, match=r"depth/1600000\.png"):
        images.frame(0)


def test_a_member_that_unpacks_to_far_too_much_is_not_unpacked(tmp_path):
    files = phones.polycam() | {"keyframes/corrected_cameras/1600000.json": bytes(65 << 20)}
    path = write_zip(tmp_path / "scan.zip", files)
    with pytest.raises(FormatError, match=r"1600000\.json.*65 MiB"):
        read_polycam(path)


@pytest.fixture(params=["folder", "archive"])
def record3d(request, tmp_path):
    if request.param == "archive":
        return write_zip(tmp_path / "scan.r3d", phones.record3d())
    lay_out(tmp_path / "scan", phones.record3d())
    return tmp_path / "scan"


def test_record3d_shows_the_room(record3d):
    capture = open_capture(record3d)
    assert capture.name == "scan"
    images = capture.source
    assert isinstance(images, PosedImages)
    assert_shows_the_room(images, Y_UP_FROM_Z_UP)
    np.testing.assert_array_equal(images.up, [0, 1, 0])
    assert [lens.params[0] for lens in images.lenses] == [33.0, 34.0, 35.0, 36.0]
    depth = images.depth(0).reshape(12, FACTOR, 16, FACTOR)
    assert (depth[:, :, -2:] == 0).all()  # not sure
    assert (depth[0, :, 0] == 0).all()  # NaN
    assert (depth[1:, :, :-2] > 0).all()


def test_record3d_from_its_first_camera_on_does_not_know_what_is_up(tmp_path):
    first = np.linalg.inv(phones.room_poses()[0] @ phones.OPENGL)
    lay_out(tmp_path, phones.record3d(first=first))
    images = read_record3d(tmp_path)
    assert images.up is None
    assert_shows_the_room(images, first)


def test_record3d_of_earlier_versions_has_one_camera_and_no_size_of_depth(tmp_path):
    import lzfse

    files = phones.record3d(size=False)
    metadata = json.loads(files["metadata"])
    del metadata["perFrameIntrinsicCoeffs"]
    metadata |= {"w": 480, "h": 640, "K": [400.0, 0, 0, 0, 401.0, 0, 240.0, 321.0, 1]}
    lidar = np.full((256, 192), 2.0, "<f4")
    lidar[0] = 1.0
    files |= {
        "metadata": json.dumps(metadata).encode(),
        "rgbd/0.depth": lzfse.compress(lidar.tobytes()),
    }
    files = {name: data for name, data in files.items() if not name.endswith("conf")}
    lay_out(
        tmp_path, files | {"rgbd/0.jpg": phones.encoded(np.zeros((640, 480, 3), np.uint8), "jpeg")}
    )
    images = read_record3d(tmp_path)
    assert images.lenses[0].params == (400.0, 401.0, 240.0, 321.0)
    depth = images.frame(0).depth
    assert depth.shape == (640, 480)
    assert (np.asarray(depth[:2]) == 1.0).all()
    assert (np.asarray(depth[3:]) == 2.0).all()


def test_record3d_without_lzfse_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "lzfse", None)
    path = write_zip(tmp_path / "scan.r3d", {"metadata": b"{}", "rgbd/0.jpg": b""})
    with pytest.raises(FormatError, match=r"scan\.r3d: .*pip install 'r3jax\[phones\]'"):
        open_capture(path)


@pytest.mark.parametrize("kind", ["folder", "folder EXR_RGBD", "archive", "png"])
def test_the_exr_export_of_record3d_shows_the_room(tmp_path, kind):
    files = phones.record3d_export("" if kind == "folder" else "EXR_RGBD/",
                                   "png" if kind == "png" else "jpg")  # fmt: skip
    path = tmp_path / "scan.zip"
    if kind != "archive":
        path = tmp_path / "scan"
        lay_out(path, files)
    else:
        write_zip(path, files)
    images = open_capture(path).source
    assert isinstance(images, PosedImages)
    assert len(images) == NUM
    assert_shows_the_room(images, Y_UP_FROM_Z_UP)
    np.testing.assert_array_equal(images.up, [0, 1, 0])
    assert images.depth(0)[0, 0] == 0.0  # NaN: no measurement


def test_an_exr_export_without_openexr_names_the_extra(tmp_path, monkeypatch):
    lay_out(tmp_path, phones.record3d_export(""))
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(FormatError, match=r"OpenEXR.*not installed.*'r3jax\[phones\]'"):
        open_capture(tmp_path)


@pytest.mark.parametrize("cut", [8, 200, -40])
def test_a_damaged_exr_is_named(tmp_path, cut):
    files = phones.record3d_export("")
    lay_out(tmp_path, files | {"depth/1.exr": files["depth/1.exr"][:cut]})
    images = read_record3d(tmp_path)
    with pytest.raises(FormatError, match=r"depth/1\.exr"):
        images.depth(1)


@pytest.fixture(params=["folder", "archive"])
def stray(request, tmp_path):
    if request.param == "archive":
        return write_zip(tmp_path / "scan.zip", phones.stray_scanner())
    lay_out(tmp_path / "scan", phones.stray_scanner())
    return tmp_path / "scan"


def test_stray_scanner_shows_the_room(stray):
    images = open_capture(stray).source
    assert isinstance(images, PosedImages)
    assert_shows_the_room(images, Y_UP_FROM_Z_UP)
    np.testing.assert_array_equal(images.up, [0, 1, 0])
    assert [lens.params[0] for lens in images.lenses] == [132.0, 136.0, 140.0, 144.0]
    assert images.image_paths[1].name == "000001"


def test_columns_of_stray_scanner_that_are_empty_are_not_known(tmp_path):
    files = phones.stray_scanner(center=True)
    lay_out(tmp_path / "today", files)
    images = open_capture(tmp_path / "today").source
    assert isinstance(images, PosedImages)
    assert_shows_the_room(images, Y_UP_FROM_Z_UP)
    assert [lens.params[0] for lens in images.lenses] == [132.0, 136.0, 140.0, 144.0]
    rows = files["odometry.csv"].decode().splitlines()
    without_pose = rows[2].split(",")
    without_pose[2:9] = [""] * 7
    without_focal_length = rows[3].split(",")
    without_focal_length[9] = " "
    rows[2:4] = [",".join(without_pose), ",".join(without_focal_length)]
    lay_out(tmp_path / "gaps", files | {"odometry.csv": "\r\n".join(rows).encode("utf-8-sig")})
    images = read_stray_scanner(tmp_path / "gaps")
    assert [lens.params[0] for lens in images.lenses] == [132.0, 132.0, 144.0]
    assert images.remark.startswith("1 of 4 frames")
    assert_shows_the_room(read_stray_scanner(tmp_path / "today"), Y_UP_FROM_Z_UP)


def test_stray_scanner_of_earlier_versions_has_one_camera(tmp_path):
    lay_out(tmp_path, phones.stray_scanner(intrinsics=False))
    images = read_stray_scanner(tmp_path)
    assert set(images.lenses) == {phones.VIDEO}
    assert_shows_the_room(images, Y_UP_FROM_Z_UP)


def test_frames_of_a_video_come_by_number_in_any_order(tmp_path):
    gray = [np.full((144, 192, 3), 20 * i, np.uint8) for i in range(12)]
    video = Video(tmp_path, phones.video(gray))
    assert len(video) == 12
    for number in (0, 1, 2, 11, 5, 4, 4, 10, 0, 7):
        assert abs(video.frame(number).mean() - 20 * number) < 4
    for number in (-1, 12):
        with pytest.raises(FormatError, match=f"12.*{number}"):
            video.frame(number)


def test_poses_after_the_end_of_a_video_are_left_out(tmp_path):
    files = phones.stray_scanner()
    shorter = [phones.view(pose, phones.VIDEO)[0] for pose in phones.room_poses()[:3]]
    lay_out(tmp_path, files | {"rgb.mp4": phones.video(shorter)})
    images = read_stray_scanner(tmp_path)
    assert len(images) == 3
    assert images.remark.startswith("1 of 4 frames")


def test_stray_scanner_without_a_matrix_says_so(tmp_path):
    files = phones.stray_scanner(intrinsics=False) | {"camera_matrix.csv": b"1,2\n3,4\n"}
    lay_out(tmp_path, files)
    with pytest.raises(FormatError, match=r"camera_matrix\.csv: line 1"):
        read_stray_scanner(tmp_path)


def test_a_video_without_pyav_names_the_extra(stray, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(FormatError, match=r"rgb\.mp4: .*pip install 'r3jax\[video\]'"):
        open_capture(stray)


def test_arkit_scenes_shows_the_room(tmp_path):
    lay_out(tmp_path / "40753679", phones.arkit_scenes())
    images = open_capture(tmp_path / "40753679").source
    assert isinstance(images, PosedImages)
    assert len(images) == NUM
    assert images.remark.startswith("1 of 5 frames")
    assert_shows_the_room(images, phones.Z_UP_FROM_ROOM, colors=1.5)
    np.testing.assert_array_equal(images.up, [0, 0, 1])
    assert [lens.params[0] for lens in images.lenses] == [34.0, 35.0, 36.0, 37.0]
    assert (images.depth(0).reshape(12, FACTOR, 16, FACTOR)[:, :, -2:] == 0).all()
