"""Which surfaces a capture without depth gets."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import r3jax
from r3jax.captures import surfaces
from r3jax.captures.source import source_of
from r3jax.captures.surfaces import with_surfaces
from r3jax.errors import InputError
from r3jax.formats.captures import open_capture
from r3jax.formats.errors import FormatError
from r3jax.formats.nerfstudio import OPENGL_FROM_OPENCV
from r3jax.kernels.constants import SH0
from r3jax.splatting.ply import write_scene
from r3jax.splatting.scene import GaussianScene
from tests.apps.audit.room import (
    HEIGHT,
    WIDTH,
    picture,
    round_poses,
    wall_points,
    write_colmap,
    write_nerfstudio,
)


def test_pixels_that_masks_hide_need_no_depth(tmp_path, monkeypatch):
    poses = round_poses(6)
    source = source_of(open_capture(write_colmap(tmp_path, poses)).source, "room")
    photograph = source.photograph
    assert photograph is not None
    is_shown = np.zeros((HEIGHT, WIDTH), dtype=bool)
    is_shown[: HEIGHT // 12] = True  # 8 % of the pixels
    swept = [np.where(is_shown, picture(pose)[1], 0.0).astype(np.float32) for pose in poses]
    monkeypatch.setattr(surfaces, "sweep", lambda photos, points, on_photo: swept)
    assert with_surfaces(source).kind == "tracks"

    def masked(index: int, stride: int):
        rgb, gray = photograph(index, stride)
        return rgb, gray * is_shown

    assert with_surfaces(dataclasses.replace(source, photograph=masked)).kind == "sweep"


MIDDLE = np.array([2.0, 1.5, 1.2])


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    folder = tmp_path_factory.mktemp("room")
    return source_of(open_capture(write_colmap(folder, round_poses(20))).source, "room")


def wall_splat(path, *, scale=1.0, shift=0.0, inverted=False):
    """A PLY of the room's walls: a round Gaussian at each point of them."""
    points, colors = wall_points()
    color = colors / np.float32(255.0)
    count = len(points)
    scene = GaussianScene(
        means=jnp.asarray(MIDDLE + scale * (points - MIDDLE) + shift, jnp.float32),
        quats=jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (count, 1)),
        log_scales=jnp.full((count, 3), np.log(0.06 * scale), jnp.float32),
        opacity_logits=jnp.full(count, 4.0),
        sh=jnp.asarray(((1.0 - color if inverted else color) - 0.5) / SH0, jnp.float32)[:, None],
    )
    write_scene(path, scene)
    return path


@pytest.mark.full
def test_a_splat_gives_the_depth_of_its_surfaces(room, tmp_path):
    found = with_surfaces(room, model=wall_splat(tmp_path / "scene.ply"))
    assert found.kind == "model"
    for index, pose in enumerate(round_poses(20)):
        depth = found.read(index)[1]
        is_known = depth > 0.0
        assert is_known.mean() > 0.3
        off = depth[is_known] / picture(pose)[1][is_known] - 1.0
        assert np.median(np.abs(off)) < 0.06


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"scale": 2.0}, r"\b(1\.[5-9]|2|2\.[0-5]) times as far"),
        ({"shift": 100.0}, r"covers 0 %"),
        ({"inverted": True}, r"only -\d\.\d\d"),
    ],
)
def test_a_splat_of_another_place_or_scale_is_refused_with_the_difference(
    room, tmp_path, wrong, said
):
    with pytest.raises(InputError, match=said):
        with_surfaces(room, model=wall_splat(tmp_path / "scene.ply", **wrong))


def test_a_splat_is_enough_for_photos_without_depth_and_points(tmp_path):
    folder = write_nerfstudio(tmp_path / "room", round_poses(12), depth=False)
    content = json.loads((folder / "transforms.json").read_text())
    del content["ply_file_path"]
    (folder / "transforms.json").write_text(json.dumps(content))
    capture = open_capture(folder)
    with pytest.raises(FormatError, match="--model"):
        source_of(capture.source, "room")
    source = source_of(capture.source, "room", can_compute=True)
    found = with_surfaces(source, model=wall_splat(tmp_path / "scene.ply"))
    known = np.mean([(found.read(index)[1] > 0.0).mean() for index in range(12)])
    assert found.kind == "model"
    assert known > 0.3
    with pytest.raises(InputError, match="covers 0 %"):
        with_surfaces(source, model=wall_splat(tmp_path / "scene.ply", shift=100.0))


def photos_of_flat(folder, count: int) -> list[np.ndarray]:
    """Writes photos of the flat with poses alone, from a line; returns their true depth."""
    camera = r3jax.Camera.from_fov(256, 192, 70.0)
    scene = r3jax.open_scene("flat", camera=camera, noise=0.0, max_range=None)
    start = np.asarray(scene.start_pose, np.float64)
    frames, depths = [], []
    for index in range(count):
        pose = start.copy()
        pose[:3, 3] += (index - count / 2) * 0.1 * start[:3, 0]  # to the right
        frame = scene.render(pose.astype(np.float32))
        rgb = np.rint(255.0 * np.asarray(frame.rgb)).astype(np.uint8)
        Image.fromarray(rgb).save(folder / f"{index}.png")
        opengl = pose @ OPENGL_FROM_OPENCV
        frames.append({"file_path": f"{index}.png", "transform_matrix": opengl.tolist()})
        depths.append(np.asarray(frame.depth))
    names = {"fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy", "w": "width", "h": "height"}
    lens = {name: float(getattr(camera, of)) for name, of in names.items()}
    (folder / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))
    return depths


@pytest.mark.full
def test_photos_with_poses_alone_are_swept(tmp_path):
    truth = photos_of_flat(tmp_path, 12)
    (tmp_path / "3.png").unlink()
    source = source_of(open_capture(tmp_path).source, "flat", can_compute=True)
    found = with_surfaces(source)
    assert found.kind == "sweep"
    assert isinstance(found.try_read(3), FormatError)
    for index in (1, 5, 10):
        depth = found.read(index)[1]
        assert (depth > 0.0).mean() > 0.3
        is_known = (depth > 0.0) & (truth[index] > 0.0) & np.isfinite(truth[index])
        off = np.abs(depth[is_known] / truth[index][is_known] - 1.0)
        assert np.median(off) < 0.03
        assert np.mean(off < 0.1) > 0.9


def test_photos_that_show_nothing_in_common_are_refused(tmp_path):
    photos_of_flat(tmp_path, 4)
    for index in range(4):  # without any texture
        Image.new("RGB", (256, 192), (100, 100, 100)).save(tmp_path / f"{index}.png")
    source = source_of(open_capture(tmp_path).source, "flat", can_compute=True)
    with pytest.raises(InputError, match=r"no depth can be computed .* poses and focal lengths"):
        with_surfaces(source)
    with pytest.raises(InputError, match="no points"):
        with_surfaces(source, "points")
