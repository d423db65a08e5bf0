"""Depth as people store it: whole numbers or floats, in four kinds of files."""

import io
import json

import numpy as np
import pytest
from PIL import Image

from r3jax.formats.captures import open_capture
from r3jax.formats.depth import stored_depth
from r3jax.formats.errors import FormatError
from r3jax.formats.nerfstudio import read_transforms
from r3jax.validation.errors import ForeignFileError
from tests.formats.phones import LENS, OPENGL, exr, room_poses, view

METERS = np.array([[0.0, np.nan, 1.5], [np.inf, -1.0, 2.25]], np.float32)
READ = np.array([[0.0, 0.0, 1.5], [np.inf, 0.0, 2.25]], np.float32)


def tiff(pixels: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "TIFF")
    return file.getvalue()


def npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


@pytest.mark.parametrize(
    "data",
    [
        tiff(METERS),
        npy(METERS),
        npy(METERS[..., None].astype(np.float64)),
        npy(np.asfortranarray(METERS)),
        exr({"R": METERS}),
        exr({"Z": METERS, **{name: np.zeros_like(METERS) for name in "RGB"}}),
        exr({"V": METERS.astype(np.float16)}),
        exr({"Y": np.where(np.isinf(METERS), np.float32(1e10), METERS)}),  # Blender's background
    ],
)
def test_floats_of_any_file_are_lengths(data):
    found = stored_depth(data)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, READ)


@pytest.mark.parametrize("write", [tiff, npy])
def test_whole_numbers_stay_steps(write):
    steps = np.array([[0, 1, 65535]], np.uint16)
    found = stored_depth(write(steps))
    assert found.dtype.kind in "iu"
    np.testing.assert_array_equal(found, steps)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (npy(METERS)[:-4], "promises 6 numbers"),
        (npy(np.array([[None]])), "no plain numbers"),
        (npy(np.zeros((2, 3, 4))), "2 x 3 x 4"),
        (b"\x93NUMPY\x01\x00\x06\x00{oops\n", "no NPY file"),
        (exr({"R": METERS, "G": METERS, "B": METERS}), "B, G, R"),
        (exr({"R": METERS})[:-20], "EXR image cannot be read"),
        (tiff(METERS)[:60], "cannot be read"),
        (tiff(np.zeros((2, 2), np.uint8)), "16 bits"),
        (b"\0\0\0\x18ftypheic\0\0\0\0mif1heic", "HEIC image.*convert"),
        (b"", "empty"),
        (b"<!DOCTYPE html><html>", "web page"),
        (b"hello", "does not begin like a PNG or TIFF"),
    ],
)
def test_what_is_no_depth_is_named(data, reason):
    with pytest.raises(ForeignFileError, match=reason):
        stored_depth(data)


def capture(folder, write, suffix="png", **keys):
    """Two views of the room as a transforms.json; `keys` are of the file, `write` makes depth."""
    frames = []
    (folder / "images").mkdir(parents=True)
    for i, pose in enumerate(room_poses()[:2]):
        rgb, depth = view(pose, LENS)
        Image.fromarray(rgb).save(folder / f"images/{i}.png")
        (folder / f"images/{i}.depth.{suffix}").write_bytes(write(depth))
        names = {"file_path": f"images/{i}.png", "depth_file_path": f"images/{i}.depth.{suffix}"}
        frames.append(names | {"transform_matrix": (pose @ OPENGL).tolist()})
    fx, fy, cx, cy = LENS.params
    lens = {"w": LENS.width, "h": LENS.height, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
    (folder / "transforms.json").write_text(json.dumps({**lens, **keys, "frames": frames}))
    return folder


def png(per_meter: float):
    def write(depth: np.ndarray) -> bytes:
        file = io.BytesIO()
        Image.fromarray(np.rint(per_meter * depth).astype(np.uint16)).save(file, "PNG")
        return file.getvalue()

    return write


@pytest.mark.parametrize(
    ("write", "suffix", "keys"),
    [
        (png(1000), "png", {}),
        (png(5000), "png", {"depth_unit_scale_factor": 0.0002}),
        (png(5000), "png", {"integer_depth_scale": 0.0002}),
        (png(5000), "png", {"integer_depth_scale": 0.0002, "depth_unit_scale_factor": 0.0002}),
        (lambda depth: npy(depth.astype(np.float32)), "npy", {}),
        (lambda depth: npy(depth.astype(np.float32)), "npy", {"integer_depth_scale": 0.0002}),
        (lambda depth: npy(1000 * depth), "npy", {"depth_unit_scale_factor": 0.001}),
        (lambda depth: tiff(depth.astype(np.float32)), "tiff", {}),
        (lambda depth: exr({"Z": depth.astype(np.float32)}), "exr", {}),
    ],
)
def test_depth_of_a_transforms_json_is_in_meters_by_any_key(tmp_path, write, suffix, keys):
    images = read_transforms(capture(tmp_path, write, suffix, **keys))
    true = view(room_poses()[0], LENS)[1]
    np.testing.assert_allclose(images.depth(0), true, atol=6e-4)


def test_instant_ngps_name_of_depth_is_read_and_two_units_are_refused(tmp_path):
    capture(tmp_path, png(5000), integer_depth_scale=0.0002)
    file = tmp_path / "transforms.json"
    file.write_text(file.read_text().replace("depth_file_path", "depth_path"))
    np.testing.assert_allclose(
        read_transforms(tmp_path).depth(1), view(room_poses()[1], LENS)[1], atol=6e-4
    )
    content = json.loads(file.read_text()) | {"depth_unit_scale_factor": 0.001}
    file.write_text(json.dumps(content))
    with pytest.raises(FormatError, match=r"depth_unit_scale_factor 0\.001.*integer_depth_scale"):
        read_transforms(tmp_path)


def test_training_views_of_nerf_are_read_and_the_others_named(tmp_path):
    capture(tmp_path, png(1000))
    (tmp_path / "transforms.json").rename(tmp_path / "transforms_train.json")
    (tmp_path / "transforms_test.json").write_text("{}")
    images = open_capture(tmp_path).source
    assert len(images) == 2
    assert "transforms_test.json" in images.remark


def test_a_lens_is_scaled_to_images_that_were_reduced(tmp_path):
    capture(tmp_path, png(1000))
    for i in range(2):
        path = tmp_path / f"images/{i}.png"
        Image.open(path).resize((LENS.width // 2, LENS.height // 2), Image.Resampling.BOX).save(
            path
        )
    images = open_capture(tmp_path).source
    assert images.lenses[0].params == tuple(0.5 * value for value in LENS.params)
    assert "24 x 18" in images.remark
    assert "48 x 36" in images.remark
    frame = images.frame(0)
    true = view(room_poses()[0], images.lenses[0])
    assert np.abs(255 * np.asarray(frame.rgb) - true[0]).mean() < 8
    assert np.abs(np.asarray(frame.depth) - true[1]).mean() < 0.05


def test_images_of_another_ratio_are_refused_with_both_sizes_and_a_turn_is_named(tmp_path):
    capture(tmp_path, png(1000))
    path = tmp_path / "images/0.png"
    turned = Image.open(path).transpose(Image.Transpose.ROTATE_90)
    exif = Image.Exif()
    exif[0x0112] = 6
    turned.save(path, exif=exif)
    images = open_capture(tmp_path).source
    with pytest.raises(FormatError, match=r"36 x 48.*48 x 36.*auto-orient"):
        images.rgb(0)
