"""ScanNet, exported and as .sens: depth has a camera of its own, and lost frames are left out."""

import numpy as np
import pytest

from r3jax.formats.captures import open_capture
from r3jax.formats.depth import resample_depth
from r3jax.formats.lenses import Lens
from r3jax.formats.posed_images import PosedImages
from r3jax.formats.sequences.scannet import read_scannet
from tests.formats import phones
from tests.formats.phones import NUM, Z_UP_FROM_ROOM
from tests.formats.test_phones import assert_shows_the_room
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
    assert "1 of 5 frames" in images.remark
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
