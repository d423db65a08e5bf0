"""RTAB-Map, exported and as a database: what it shows lies where the room has its walls."""

import sqlite3
import struct
import zlib

import numpy as np
import pytest

from r3jax.formats.captures import open_capture
from r3jax.formats.errors import FormatError
from r3jax.formats.posed_images import PosedImages
from r3jax.formats.ros.messages import unpack_rvl
from r3jax.formats.ros.rtabmap import read_rtabmap_database
from r3jax.validation.errors import ForeignFileError
from tests.formats import rtabmap
from tests.formats.bags import camera_poses, rvl
from tests.formats.phones import FACTOR, LENS, NUM, Z_UP_FROM_ROOM
from tests.formats.sequences import encoded
from tests.formats.test_phones import JPEG, assert_shows_the_room
from tests.fuzz.tree import lay_out

LOSSLESS = 1.5
"""Mean error of colors [of 255] that rounding leaves."""


def test_an_export_shows_the_room(tmp_path):
    lay_out(tmp_path / "scan", rtabmap.export())
    images = open_capture(tmp_path / "scan").source
    assert isinstance(images, PosedImages)
    assert len(images) == NUM
    assert images.remark is None
    assert set(images.lenses) == {LENS}
    assert_shows_the_room(images, Z_UP_FROM_ROOM, JPEG)
    np.testing.assert_array_equal(images.up, [0, 0, 1])


@pytest.mark.parametrize("optimized", [True, False])
def test_a_database_shows_the_room(tmp_path, optimized):
    (tmp_path / "map.db").write_bytes(rtabmap.database(optimized))
    capture = open_capture(tmp_path / "map.db")
    assert capture.name == "map"
    images = capture.source
    assert isinstance(images, PosedImages)
    assert len(images) == (NUM - 1 if optimized else NUM)
    assert_shows_the_room(images, Z_UP_FROM_ROOM, LOSSLESS)
    np.testing.assert_allclose(images.poses, camera_poses()[: len(images)], atol=1e-5)
    for index in range(len(images)):
        assert (images.depth(index)[:FACTOR, :FACTOR] == 0).all()
    assert ("1 of 4 images" in images.remark) == optimized


STATEMENTS = {
    "stereo": (
        "UPDATE Data SET calibration = ?",
        (struct.pack("<11i", 0, 21, 4, 1, *[0] * 7),),
        "stereo rig or of an old version: export depth images by rtabmap-export",
    ),
    "two cameras": (
        "UPDATE Data SET calibration = ?", (2 * rtabmap.calibration(),), "several cameras",
    ),
    "cut off": (
        "UPDATE Data SET calibration = ?", (rtabmap.calibration()[:80],), "node 5",
    ),
    "no depth": ("UPDATE Data SET depth = NULL", (), "of 4 images in it none has depth"),
    "empty": ("DELETE FROM Data", (), "4 nodes and no image: .*Mem/BinDataKept"),
    "graph": ("UPDATE Admin SET opt_ids = opt_poses", (), "the optimized poses are damaged"),
    "zlib": ("UPDATE Admin SET opt_ids = ?", (b"1234",), "the optimized poses are damaged"),
    "view": ("ALTER TABLE Node RENAME TO Old; CREATE VIEW Node AS SELECT * FROM Old", (),
             "its `Node` is a view"),
    "computed": ("ALTER TABLE Data RENAME TO Old; CREATE TABLE Data (id, image, depth, "
                 "calibration AS (zeroblob(900000000)))", (), "`calibration` of its `Data`"),
    "old": ("ALTER TABLE Data DROP COLUMN depth", (), "no such column.* rtabmap-export"),
}  # fmt: skip


@pytest.mark.parametrize("damage", STATEMENTS)
def test_a_database_that_lacks_something_says_so(tmp_path, damage):
    sql, values, message = STATEMENTS[damage]
    path = tmp_path / "map.db"
    path.write_bytes(rtabmap.database())
    connection = sqlite3.connect(path)
    for statement in sql.split("; "):
        connection.execute(statement, values)
    connection.commit()
    connection.close()
    with pytest.raises(FormatError, match=message) as found:
        open_capture(path)
    assert str(path) in str(found.value)


def test_a_database_that_was_copied_in_part_says_so(tmp_path):
    path = tmp_path / "map.db"
    whole = rtabmap.database()
    for lost in (1, 1000, len(whole) // 2):
        path.write_bytes(whole[:-lost])
        with pytest.raises(FormatError, match="copy"):
            open_capture(path)


@pytest.mark.parametrize(
    "content", [b"", b"SQLite format 3\0", b"x" * 200, b"SQLite format 3\0" * 20]
)
def test_what_is_no_database_says_so(tmp_path, content):
    path = tmp_path / "map.db"
    path.write_bytes(content)
    with pytest.raises(FormatError, match=r"map\.db"):
        open_capture(path)
    with pytest.raises(FormatError, match=r"map\.db"):
        read_rtabmap_database(path)


def test_rvl_comes_back_and_damage_is_refused():
    rng = np.random.default_rng(0)
    steps = rng.integers(0, 65_536, (17, 23)).astype(np.uint16)
    steps[rng.random(steps.shape) < 0.4] = 0
    for image in (steps, np.zeros((2, 3), np.uint16), np.full((1, 5), 65_535, np.uint16)):
        np.testing.assert_array_equal(unpack_rvl(rvl(image)), image)
    good = rvl(steps)
    for bad in (good[:4], good[:40], struct.pack("<II", 1 << 20, 1 << 20), good[:8] + b"\xff" * 40,
                good[:8] + b"\xff\xff\xff\x0f" * 9):  # fmt: skip
        with pytest.raises(ForeignFileError, match="a depth image "):
            unpack_rvl(bad)


def with_confidence(path, content: bytes) -> None:
    """Gives the first node a confidence."""
    connection = sqlite3.connect(path)
    connection.execute("ALTER TABLE Data ADD COLUMN depth_confidence BLOB")
    connection.execute("UPDATE Data SET depth_confidence = ? WHERE id = 5", (content,))
    connection.commit()
    connection.close()


@pytest.mark.parametrize("how", ["png", "zlib"])
def test_depth_below_the_best_confidence_is_no_measurement(tmp_path, how):
    path = tmp_path / "map.db"
    path.write_bytes(rtabmap.database())
    before = open_capture(path).source
    levels = np.full((LENS.height // FACTOR, LENS.width // FACTOR), 100, np.uint8)
    levels[:, 1] = 99
    packed = zlib.compress(levels.tobytes()) + struct.pack("<3i", *levels.shape, 0)
    with_confidence(path, encoded(levels) if how == "png" else packed)
    images = open_capture(path).source
    stored = images.pixels.depth(0)
    assert (stored[:, 1] == 0).all()
    np.testing.assert_array_equal(stored[:, 2:], before.pixels.depth(0)[:, 2:])
    np.testing.assert_array_equal(images.pixels.depth(1), before.pixels.depth(1))


@pytest.mark.parametrize("content", [b"", b"no", zlib.compress(b"") + struct.pack("<3i", 9, 9, 0)])
def test_a_damaged_confidence_is_refused_and_an_empty_one_is_none(tmp_path, content):
    path = tmp_path / "map.db"
    path.write_bytes(rtabmap.database())
    with_confidence(path, content)
    images = open_capture(path).source
    if not content:
        assert (images.depth(0) > 0).any()
        return
    with pytest.raises(FormatError, match=r"depth.5.*confidence"):
        images.depth(0)
