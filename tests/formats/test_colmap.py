"""COLMAP models: laws of writing and reading, by hand-written files, and by damaged ones."""

import dataclasses
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from PIL import Image
from scipy.spatial.transform import Rotation

from r3jax.errors import InputError
from r3jax.formats.colmap.binary import read_binary, write_binary
from r3jax.formats.colmap.model import (
    ColmapImage,
    ColmapModel,
    colmap_pose,
    points_without_tracks,
    pose_of,
)
from r3jax.formats.colmap.reader import read_colmap
from r3jax.formats.colmap.text import read_text, write_text
from r3jax.formats.errors import FormatError
from r3jax.formats.lenses import Lens
from tests.formats.colmap_models import assert_equal, random_model, random_pose, seeds

WAYS = {"binary": (write_binary, read_binary), "text": (write_text, read_text)}

CAMERAS = """# Camera list
# Number of cameras: 2

7 SIMPLE_RADIAL 640 480 500.5 320 240 -0.01
3 PINHOLE 20 10 15 16 10 5
"""
IMAGES = """# Image list
20 0.7071068 0 0 0.7071068 1 2 3 7 second image.png
1.5 2.5 11 3.5 4.5 -1
# Number of images follows
10 1 0 0 0 0 0 0 3 a/first.png

"""
POINTS = """11 1 2 3 255 128 0 0.5 20 0 10 4 20 1 99 3
5 -1 -2 -3 0 0 0 -1
"""
CAPTURE = {"cameras.txt": CAMERAS, "images.txt": IMAGES, "points3D.txt": POINTS}


@pytest.fixture
def capture(tmp_path):
    folder = tmp_path / "capture" / "sparse" / "0"
    folder.mkdir(parents=True)
    for name, text in CAPTURE.items():
        (folder / name).write_text(text)
    return tmp_path / "capture"


@pytest.mark.parametrize("way", WAYS)
@given(seed=seeds)
def test_what_is_written_is_read_bit_for_bit(way, seed):
    (write, read), model = WAYS[way], random_model(seed)
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder), model)
        assert_equal(read(Path(folder)), model)


@given(seed=seeds)
def test_poses_go_there_and_back(seed):
    T = random_pose(seed)
    quaternion, translation = colmap_pose(T)
    np.testing.assert_allclose(pose_of(quaternion, translation), T, atol=1e-12)
    np.testing.assert_allclose(pose_of(-quaternion, translation), T, atol=1e-12)
    x_world = np.array([1.0, -2.0, 3.0])
    by_colmap = Rotation.from_quat(quaternion[[1, 2, 3, 0]]).apply(x_world) + translation
    np.testing.assert_allclose(by_colmap, T[:3, :3].T @ (x_world - T[:3, 3]), atol=1e-9)


def test_a_point_before_the_camera_is_where_colmap_says(capture):
    """By the formulas of the documentation, not by ours: x_camera = R x_world + t."""
    images = read_colmap(capture)
    assert [path.name for path in images.image_paths] == ["first.png", "second image.png"]
    x_world = np.array([3.0, -4.0, 5.0, 1.0])
    x_camera = np.linalg.inv(images.poses[1]) @ x_world
    # Hamilton's quaternion (sqrt 1/2, 0, 0, sqrt 1/2) turns x into y and y into -x.
    np.testing.assert_allclose(x_camera[:3], [4.0 + 1.0, 3.0 + 2.0, 5.0 + 3.0], atol=1e-6)
    np.testing.assert_array_equal(images.poses[0], np.eye(4))


def test_cameras_names_and_tracks_of_a_file_written_by_hand(capture):
    (capture / "images").mkdir()
    images = read_colmap(capture)
    first, second = images.lenses
    assert (first.model, first.intrinsics) == ("PINHOLE", (15.0, 16.0, 10.0, 5.0))
    assert first.is_pinhole
    assert second.distortion == {"k": -0.01}
    assert not second.is_pinhole
    assert images.image_paths[1] == capture / "images" / "second image.png"
    points = images.points
    assert points is not None
    np.testing.assert_array_equal(points.xyz, [[1, 2, 3], [-1, -2, -3]])
    np.testing.assert_array_equal(points.seen_by(0), [0])  # the track's image 99 is not there
    np.testing.assert_array_equal(points.seen_by(1), [0])
    assert len(points.seen_image) == 3


@pytest.mark.parametrize(
    "place",
    [".", "sparse", "colmap/sparse/0", "distorted/sparse/0", "sparse/3", "dense/0/sparse"],
)
def test_the_model_is_found_where_tools_put_it(tmp_path, place):
    (tmp_path / place).mkdir(parents=True, exist_ok=True)
    write_binary(tmp_path / place, random_model(3))
    found = read_colmap(tmp_path)
    assert len(found) == len(random_model(3).images)
    assert found.image_paths[0].is_relative_to(tmp_path / "images")  # where they should be
    elsewhere = read_colmap(tmp_path / place, images=tmp_path / "photos")
    assert elsewhere.image_paths[0].is_relative_to(tmp_path / "photos")


@pytest.fixture
def split(tmp_path):
    """A capture that COLMAP could not join: three models, and pictures without a pose."""
    models = {"0": random_model(3), "1": random_model(1), "10": random_model(2)}
    lens = Lens("PINHOLE", 40, 30, (33.0, 33.0, 20.0, 15.0))  # random ones are no real lenses
    models = {
        name: ColmapModel(dict.fromkeys(model.cameras, lens), model.images, model.points)
        for name, model in models.items()
    }
    for name, model in models.items():
        (tmp_path / "sparse" / name).mkdir(parents=True)
        write_binary(tmp_path / "sparse" / name, model)
    (tmp_path / "sparse" / "old").mkdir()
    return tmp_path, {name: len(model.images) for name, model in models.items()}


def test_of_several_models_the_one_with_most_images_is_taken(split):
    folder, counts = split
    best = max(counts, key=counts.__getitem__)
    assert best != "0"
    assert list(counts.values()).count(counts[best]) == 1
    images = read_colmap(folder)
    assert len(images) == counts[best]
    assert images.remark is not None
    assert f"sparse/{best} is used, with {counts[best]} pictures" in images.remark
    for name in counts:
        if name != best:
            assert f"sparse/{name} has {counts[name]} " in images.remark
    asked_for = read_colmap(folder / "sparse" / "0")
    assert len(asked_for) == counts["0"]
    assert asked_for.remark is None


def part_of(names: list[str]) -> ColmapModel:
    """A model of some pictures, without points."""
    none = np.zeros((0, 2)), np.zeros(0, np.int64)
    images = tuple(
        ColmapImage(i, name, 1, np.array([1.0, 0, 0, 0]), np.array([i, 0.0, 0]), *none)
        for i, name in enumerate(names, start=1)
    )
    lens = Lens("PINHOLE", 40, 30, (33.0, 33.0, 20.0, 15.0))
    return ColmapModel(
        {1: lens}, images, points_without_tracks(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    )


@pytest.mark.parametrize("alike", [False, True])
def test_the_place_is_named_where_pictures_would_join_two_models(tmp_path, alike):
    names = [f"{i:02d}.png" for i in range(12)]
    parts = {"0": names[:7], "1": names[8:], "2": names[2:5], "3": [*names[:3], "99.png"]}
    (tmp_path / "images").mkdir()
    rng = np.random.default_rng(0)
    looks = {name: rng.integers(0, 255, (30, 40, 3), np.uint8) for name in [*names, "99.png"]}
    if alike:  # the walk came back here
        looks["10.png"] = looks["02.png"]
    for name, look in looks.items():
        Image.fromarray(look).resize((40, 30)).save(tmp_path / "images" / name)
    for number, part in parts.items():
        (tmp_path / "sparse" / number).mkdir(parents=True)
        write_binary(tmp_path / "sparse" / number, part_of(part))
    remark = read_colmap(tmp_path).remark
    assert remark is not None
    ends = ("02.png", "10.png") if alike else ("06.png", "08.png")
    assert f"pictures between {ends[0]} and {ends[1]}" in remark
    assert "sparse/2 has 3 of the same" in remark
    assert "3 of them in both: colmap model_merger" in remark
    assert "no model has 07.png" in remark
    assert len(read_colmap(tmp_path / "sparse")) == 7  # the folder of the models


def test_pictures_that_were_not_undistorted_have_no_pose(tmp_path):
    """Seen in a public repository: input/ has 40 pictures, images/ the 3 of the model."""
    names = [f"{i:02d}.png" for i in range(5)]
    for place, some in (("images", names[:2]), ("input", names)):
        (tmp_path / place).mkdir()
        for name in some:
            Image.new("RGB", (40, 30)).save(tmp_path / place / name)
    (tmp_path / "sparse/0").mkdir(parents=True)
    write_binary(tmp_path / "sparse/0", part_of(names[:2]))
    images = read_colmap(tmp_path)
    assert "only 2 of 5 have a pose" in str(images.remark)
    assert "no model has 02.png, 03.png, 04.png" in str(images.remark)
    assert images.reconstruction is not None
    assert images.reconstruction.pictures == 5


def test_a_larger_model_that_was_not_undistorted_is_named(tmp_path):
    """Seen in a public repository: convert.py undistorted a model of 3 pictures; 1 has 44."""
    names = [f"{i:02d}.png" for i in range(9)]
    (tmp_path / "images").mkdir()
    for name in names:
        Image.new("RGB", (40, 30)).save(tmp_path / "images" / name)
    parts = {
        "sparse/0": names[:2],
        "distorted/sparse/0": names[:2],
        "distorted/sparse/1": names[2:],
    }
    for place, part in parts.items():
        (tmp_path / place).mkdir(parents=True)
        write_binary(tmp_path / place, part_of(part))
    images = read_colmap(tmp_path)
    assert len(images) == 2
    assert images.remark is not None
    assert f"{tmp_path / 'distorted/sparse/1'} has 7 pictures" in images.remark
    assert "no model has" not in images.remark
    assert len(read_colmap(tmp_path / "distorted/sparse/1")) == 7
    (tmp_path / "distorted/sparse/1/images.bin").write_bytes(b"")  # damaged: only not named
    assert "no model has 02.png" in str(read_colmap(tmp_path).remark)


def test_pictures_without_a_pose_are_counted(capture):
    (capture / "images").mkdir()
    assert read_colmap(capture).remark is None
    for name in ("second image.png", "third.png", "notes.txt"):
        (capture / "images" / name).touch()
    remark = read_colmap(capture).remark
    assert remark is not None
    assert remark.startswith("2 of 3 pictures have a pose")
    assert "third.png" in remark
    for i in range(4):
        (capture / "images" / f"further{i}.png").touch()
    found = read_colmap(capture)
    assert found.remark is not None
    assert found.remark.startswith("The reconstruction failed for most pictures: only 2 of 7")
    assert found.reconstruction is not None
    assert (found.reconstruction.posed, found.reconstruction.pictures) == (2, 7)


def test_binary_goes_before_text(capture):
    write_binary(capture / "sparse" / "0", random_model(1))
    assert len(read_colmap(capture)) == len(random_model(1).images)


def test_a_distorted_image_is_no_frame(capture):
    images = read_colmap(capture)
    with pytest.raises(FormatError, match=r"distorted \(SIMPLE_RADIAL\): undistort"):
        images.frame(1)
    with pytest.raises(FormatError, match="depth"):
        images.frame(0)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_a_binary_that_promises_too_much_is_refused_before_memory_is_taken(tmp_path, name):
    write_binary(tmp_path, random_model(0))
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes((10**12).to_bytes(8, "little") + data[8:])
    with pytest.raises(FormatError, match=rf"{name}: .*1000000000000 .*only \d+ bytes"):
        read_colmap(tmp_path)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_a_binary_of_any_other_length_is_refused(tmp_path, name):
    write_binary(tmp_path, random_model(2))
    data = (tmp_path / name).read_bytes()
    for other in [data[:length] for length in range(len(data))] + [data + b"\0"]:
        (tmp_path / name).write_bytes(other)
        with pytest.raises(FormatError, match=name):
            read_binary(tmp_path)


def test_a_name_that_no_line_holds_is_not_written(tmp_path):
    model = random_model(0)
    torn = dataclasses.replace(model.images[0], name="two\nlines.png")
    model = dataclasses.replace(model, images=(torn,))
    with pytest.raises(InputError):
        write_text(tmp_path, model)


def test_no_model_is_said(tmp_path):
    with pytest.raises(FormatError):
        read_colmap(tmp_path)
    with pytest.raises(FormatError):
        read_colmap(tmp_path / "nowhere")


def depth_map(depth: np.ndarray) -> bytes:
    """As COLMAP's stereo writes it."""
    height, width = depth.shape
    return f"{width}&{height}&1&".encode() + depth.astype("<f4").tobytes()


@pytest.fixture
def dense(capture):
    """An undistorted capture with stereo, beside the model that it was made of."""
    folder = capture / "dense" / "0"
    (folder / "images" / "a").mkdir(parents=True)
    (folder / "stereo" / "depth_maps" / "a").mkdir(parents=True)
    (folder / "sparse").mkdir()
    undistorted = CAMERAS.replace(
        "SIMPLE_RADIAL 640 480 500.5 320 240 -0.01", "PINHOLE 20 10 15 16 10 5"
    )
    for name, text in {**CAPTURE, "cameras.txt": undistorted}.items():
        (folder / "sparse" / name).write_text(text)
    for name in ("rigs.bin", "frames.bin"):
        (folder / "sparse" / name).write_bytes(b"what they say is in images.bin, too")
    Image.new("RGB", (20, 10)).save(folder / "images" / "a" / "first.png")
    Image.new("RGB", (20, 10)).save(folder / "images" / "second image.png")
    return capture


def test_depth_of_colmaps_stereo_is_read_where_it_lies(dense):
    depths = dense / "dense" / "0" / "stereo" / "depth_maps"
    ramp = np.arange(200.0).reshape(10, 20)
    (depths / "a" / "first.png.photometric.bin").write_bytes(depth_map(ramp + 7.0))
    assert read_colmap(dense).is_stereo
    np.testing.assert_array_equal(read_colmap(dense).depth(0), ramp + 7.0)
    (depths / "a" / "first.png.geometric.bin").write_bytes(depth_map(ramp))
    images = read_colmap(dense)
    np.testing.assert_array_equal(images.depth(0), ramp)  # checked between images: goes first
    assert images.depth(1) is None
    assert all(path.is_file() for path in images.image_paths)
    assert all(lens.is_pinhole for lens in images.lenses)


def test_undistorted_images_do_where_the_photos_were_not_kept(dense):
    """Without any depth of the stereo; with a photo of the model's own, that goes first."""
    images = read_colmap(dense)
    assert all(path.is_file() for path in images.image_paths)
    assert all(lens.is_pinhole for lens in images.lenses)
    (dense / "images" / "a").mkdir(parents=True)
    Image.new("RGB", (20, 10)).save(dense / "images" / "a" / "first.png")
    assert not all(lens.is_pinhole for lens in read_colmap(dense).lenses)


@pytest.mark.parametrize(
    "data",
    [
        depth_map(np.ones((10, 20)))[:-1],
        depth_map(np.ones((10, 20))) + b"\0",
        b"99999999&99999999&1&",
        b"20&10&3&" + bytes(2400),
    ],
)
def test_a_damaged_depth_map_of_colmap_is_refused(dense, data):
    path = dense / "dense" / "0" / "stereo" / "depth_maps" / "a" / "first.png.geometric.bin"
    path.write_bytes(data)
    with pytest.raises(FormatError, match="geometric"):
        read_colmap(dense).depth(0)


def test_a_lens_that_none_has_is_said(capture):
    cameras = CAMERAS.replace("PINHOLE 20 10 15 16", "PINHOLE 540 360 315 753")
    (capture / "sparse" / "0" / "cameras.txt").write_text(cameras)
    remark = read_colmap(capture).remark
    assert remark is not None
    assert "315 and 753 px" in remark


def test_masks_beside_the_images_are_honored(capture):
    (capture / "images" / "a").mkdir(parents=True)
    (capture / "masks" / "a").mkdir(parents=True)
    Image.new("RGB", (20, 10), (9, 8, 7)).save(capture / "images" / "a" / "first.png")
    mask = np.zeros((5, 10), np.uint8)
    mask[:, 4:] = 255
    Image.fromarray(mask).save(capture / "masks" / "a" / "first.png.png")  # as COLMAP names it
    rgb, is_there = read_colmap(capture).masked_rgb(0)
    assert rgb.shape == (10, 20, 3)
    assert is_there is not None
    np.testing.assert_array_equal(is_there, np.arange(20)[None].repeat(10, axis=0) >= 8)
