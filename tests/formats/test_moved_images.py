"""Images that lie under another name, or were scaled, since the model was made."""

import shutil

import numpy as np
import pytest
from PIL import Image

from r3jax.formats.captures import open_capture
from r3jax.formats.colmap.reader import read_colmap
from r3jax.formats.lenses import MODELS, Lens
from r3jax.formats.posed_images import PosedImages
from tests.apps.audit.room import (
    HEIGHT,
    LENS,
    WIDTH,
    round_poses,
    write_colmap,
    write_nerfstudio,
)

POSES = round_poses(3)


@pytest.fixture
def model(tmp_path):
    return write_colmap(tmp_path / "scan", POSES)


def opened(path) -> PosedImages:
    images = open_capture(path).source
    assert isinstance(images, PosedImages)
    return images


def scale_images(folder, size):
    for path in folder.iterdir():
        Image.open(path).resize(size).save(path)


@pytest.mark.parametrize("name", ["images", "input", "images_2", "images_4", "images_8", "."])
@pytest.mark.parametrize("given", [".", "sparse/0"])
def test_images_are_found_where_programs_put_them(model, name, given):
    expected = read_colmap(model).rgb(2)
    if name == ".":
        for image in (model / "images").iterdir():
            image.rename(model / image.name)
    elif name != "images":
        (model / "images").rename(model / name)
    images = opened(model / given)
    np.testing.assert_array_equal(images.rgb(2), expected)
    assert images.remark is None


def test_the_folder_with_most_of_the_images_is_taken(model):
    shutil.copytree(model / "images", model / "input")
    (model / "images" / "001.png").unlink()
    assert {path.parent.name for path in read_colmap(model).image_paths} == {"input"}


def test_images_that_were_undistorted_afterwards_are_not_those_of_the_model(model):
    shutil.copytree(model / "images", model / "input")
    scale_images(model / "images", (WIDTH + 4, HEIGHT - 6))
    assert {path.parent.name for path in read_colmap(model).image_paths} == {"input"}


def test_the_intrinsics_follow_images_that_were_scaled(model):
    scale_images(model / "images", (WIDTH // 4, HEIGHT // 4))
    (model / "images").rename(model / "images_4")
    images = opened(model)
    fx, fy, cx, cy = LENS.intrinsics
    assert images.lenses[0].intrinsics == (fx / 4, fy / 4, cx / 4, cy / 4)
    assert images.rgb(0).shape == (HEIGHT // 4, WIDTH // 4, 3)
    assert images.remark is not None
    assert f"{WIDTH // 4} x {HEIGHT // 4}" in images.remark
    assert f"{WIDTH} x {HEIGHT}" in images.remark


@pytest.mark.parametrize("name", ["input", "images_8", "."])
def test_the_images_of_a_transforms_json_are_found_there_too(tmp_path, name):
    """Seen in a public repository: 302 pictures beside the file that says images/."""
    path = write_nerfstudio(tmp_path / "scan", POSES, depth=True)
    expected = opened(path).rgb(2)
    (path / name).mkdir(exist_ok=True)
    for image in (path / "images").iterdir():
        image.rename(path / name / image.name)
    np.testing.assert_array_equal(opened(path).rgb(2), expected)


def test_images_of_one_name_in_two_folders_are_not_confused(tmp_path):
    path = write_nerfstudio(tmp_path / "scan", POSES[:2], depth=True)
    told = (path / "transforms.json").read_text()
    told = told.replace("images/000.png", "left/0.png").replace("images/001.png", "right/0.png")
    (path / "transforms.json").write_text(told)
    (path / "images" / "000.png").rename(path / "0.png")
    assert not opened(path).has_images


@pytest.mark.parametrize("folder", ["images", "images_4"])
def test_so_do_those_of_a_transforms_json(tmp_path, folder):
    path = write_nerfstudio(tmp_path / "scan", POSES, depth=True)
    scale_images(path / "images", (WIDTH // 4, HEIGHT // 4))
    (path / "images").rename(path / folder)
    images = opened(path)
    assert images.lenses[0].intrinsics[0] == LENS.intrinsics[0] / 4
    frame = images.frame(1)  # the depth images stayed as they were
    assert frame.depth.shape == (HEIGHT // 4, WIDTH // 4)
    assert frame.rgb.shape == (HEIGHT // 4, WIDTH // 4, 3)


def test_one_image_of_another_size_does_not_change_the_others(tmp_path):
    path = write_nerfstudio(tmp_path / "scan", POSES, depth=True)
    Image.open(path / "images" / "000.png").resize((24, 18)).save(path / "images" / "000.png")
    images = opened(path)
    assert set(images.lenses) == {LENS}


@pytest.mark.parametrize(
    ("size", "fits"),
    [((12, 9), True), ((96, 72), True), ((13, 9), True), ((36, 48), False), ((48, 27), False)],
)
def test_a_scaled_image_has_the_shape_of_its_lens(size, fits):
    assert LENS.has_shape(*size) == fits
    assert not LENS.has_shape(0, 0)


@pytest.mark.parametrize("model", MODELS)
def test_a_resized_lens_shows_the_same(model):
    """Focal lengths and principal points scale, distortion has no unit."""
    whole = {"EQUIRECTANGULAR": (40.0, 20.0), "DUAL_FISHEYE": (200.0,)}
    params = whole.get(model, tuple(10.0 + i for i in range(len(MODELS[model][1]))))
    lens = Lens(model, 40, 20, params)
    half = lens.resized(20, 10)
    np.testing.assert_allclose(half.intrinsics, np.array(lens.intrinsics) / 2)
    assert half.distortion == lens.distortion
    assert half.resized(40, 20) == lens
