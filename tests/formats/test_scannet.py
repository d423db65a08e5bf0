"""ScanNet, exported and as .sens: depth has a camera of its own, and lost frames are left out."""

import struct

import numpy as np
import pytest

from r3jax.formats.captures import open_capture
from r3jax.formats.depth_images import resample_depth
from r3jax.formats.errors import FormatError
from r3jax.formats.lenses import Lens
from r3jax.formats.posed_images import PosedImages
from r3jax.formats.sequences.scannet import read_scannet
from r3jax.formats.sequences.scannet_sens import read_sens
from tests.formats import phones
from tests.formats.phones import NUM, Z_UP_FROM_ROOM
from tests.formats.test_phones import assert_shows_the_room, damaged
from tests.fuzz.tree import lay_out

SENS = "scene0000_00.sens"


@pytest.fixture(params=["export", "sens", "plain sens", "folder of a sens"])
def path(request, tmp_path):
    if request.param == "export":
        lay_out(tmp_path / "scene0000_00", phones.scannet())
        return tmp_path / "scene0000_00"
    (tmp_path / SENS).write_bytes(phones.sens(packed="plain" not in request.param))
    return tmp_path if "folder" in request.param else tmp_path / SENS


def test_a_scene_shows_the_room(path):
    capture = open_capture(path)
    images = capture.source
    assert isinstance(images, PosedImages)
    assert len(images) == NUM
    assert images.remark == "1 of 5 frames have no pose and are left out."
    assert images.lenses[0].params == pytest.approx(phones.LENS.params)
    np.testing.assert_array_equal(images.up, [0, 0, 1])
    assert_shows_the_room(images, Z_UP_FROM_ROOM)


def test_frames_of_an_export_come_in_the_order_of_their_numbers(tmp_path):
    lay_out(tmp_path, phones.scannet())
    names = [image.name for image in read_scannet(tmp_path).image_paths]
    assert names == ["9.jpg", "11.jpg", "12.jpg", "13.jpg"]


def test_rays_beside_the_depth_image_have_no_depth():
    depth = np.arange(1.0, 13.0, dtype=np.float32).reshape(3, 4)
    narrow = Lens("PINHOLE", 4, 3, (10.0, 10.0, 2.0, 1.5))
    wide = Lens("PINHOLE", 8, 5, (10.0, 10.0, 3.0, 2.5))
    found = resample_depth(depth, wide, narrow)
    expected = np.zeros((5, 8), np.float32)
    expected[1:4, 1:5] = depth
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(resample_depth(depth, narrow), depth)


EXPORT = {
    "pose": (damaged("pose/11", None), r"pose/11\.txt: the file is missing"),
    "short": (damaged("pose/11", lambda data: b"1 0 0 0"), "expected a 4x4 matrix, got 1 lines"),
    "rigid": (damaged("pose/11", lambda data: data.replace(b"0.", b"7.")), r"11\.txt: the pose"),
    "lost": (
        lambda files: {n: b"inf inf inf inf\n" * 4 if "pose/" in n else d
                       for n, d in files.items()}, "no frame has a pose that is finite",
    ),
    "camera": (damaged("intrinsic_color", lambda data: b"1 2 3"), r"_color\.txt: expected"),
    "focal": (damaged("intrinsic_depth", lambda data: b"0 0 0 0\n" * 4), "no camera has the focal"),
    "missing": (damaged("intrinsic/", None), "an export of ScanNet without pose/ and intrinsic/"),
}  # fmt: skip


@pytest.mark.parametrize("damage", EXPORT)
def test_a_damaged_export_is_named(tmp_path, damage):
    break_it, message = EXPORT[damage]
    lay_out(tmp_path, break_it(phones.scannet()))
    with pytest.raises(FormatError, match=message) as found:
        open_capture(tmp_path)
    assert str(tmp_path) in str(found.value)


def put(at, kind, *values):
    """Numbers at a place of the file; places are behind the name of 15 letters."""

    def change(data):
        packed = struct.pack(kind, *values)
        return data[:at] + packed + data[at + len(packed) :]

    return change


FILE = {
    "version": (put(0, "<I", 3), "its version is 3, only 4 is read"),
    "name": (put(4, "<Q", 1 << 40), "the name of its sensor has 1099511627776 characters"),
    "codec": (put(283, "<i", 0), "the codecs of color and depth are 0 and 1"),
    "size": (put(291, "<I", 1 << 20), "more than 16777216 pixels"),
    "steps": (put(307, "<f", 0.0), "0 steps of depth a meter make no sense"),
    "count": (put(311, "<Q", 1 << 50), "it claims to hold 1125899906842624 frames"),
    "cut": (lambda data: data[:-500], "the file is cut off: download or copy it again"),
    "head": (lambda data: data[:100], "the file is cut off"),
    "focal": (put(27, "<f", 0.0), "no camera has the focal lengths 0"),
}


@pytest.mark.parametrize("damage", FILE)
def test_a_damaged_sens_file_is_named(tmp_path, damage):
    change, message = FILE[damage]
    (tmp_path / SENS).write_bytes(change(phones.sens()))
    with pytest.raises(FormatError, match=rf"{SENS}: {message}"):
        open_capture(tmp_path / SENS)


def test_damaged_pixels_of_a_sens_file_are_named(tmp_path):
    data = phones.sens()
    color = data.find(b"\xff\xd8")
    depth = data.find(b"\x78\x9c", color)
    for at, message in ((color, "the image cannot be read"), (depth, "a depth image is damaged")):
        (tmp_path / SENS).write_bytes(data[:at] + bytes(9) + data[at + 9 :])
        images = read_sens(tmp_path / SENS)
        with pytest.raises(FormatError, match=rf"{SENS}: {message}"):
            images.frame(0)
