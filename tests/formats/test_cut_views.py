"""Views cut from 360 photos: each pixel shows what its ray meets, by the photo's own formula."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from r3jax.captures.source import source_of
from r3jax.captures.sweep import Photo, choose_sources
from r3jax.errors import InputError
from r3jax.formats.captures import open_capture
from r3jax.formats.cut import Cut
from r3jax.formats.cut_views import FACES, cut_wide, is_wide
from r3jax.formats.errors import FormatError
from r3jax.formats.lenses import Lens, project_rays
from r3jax.formats.nerfstudio import OPENGL_FROM_OPENCV
from r3jax.formats.points import write_points
from r3jax.formats.posed_images import PosedImages, SparsePoints
from tests.apps.audit.room import SIZE, color_of, pose_at

WIDTH = 256
PANORAMA = Lens("EQUIRECTANGULAR", WIDTH, WIDTH // 2, (float(WIDTH), float(WIDTH // 2)))
FISHEYE = Lens("OPENCV_FISHEYE", 128, 128, (36.0, 36.0, 64.0, 64.0, 0.01, 0.0, 0.0, 0.0))
"""Equidistant but for a little distortion, of some 200 degrees."""

DUAL = Lens("DUAL_FISHEYE", WIDTH, WIDTH // 2, (200.0,))


def walls(eye: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points of the room's walls that rays from inside meet, and their distances."""
    with np.errstate(divide="ignore"):
        length = np.where(rays > 0, (SIZE - eye) / rays, -eye / rays).min(axis=-1)
    return eye + length[..., None] * rays, length * np.linalg.norm(rays, axis=-1)


def panorama_rays(width: int = WIDTH) -> np.ndarray:
    """COLMAP's and nerfstudio's formula, from pixels to rays [h, w, 3]."""
    theta = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    phi = ((np.arange(width // 2) + 0.5) / (width // 2) - 0.5) * np.pi
    theta, phi = np.meshgrid(theta, phi)
    return np.stack([np.cos(phi) * np.sin(theta), np.sin(phi), np.cos(phi) * np.cos(theta)], -1)


def fisheye_rays(lens: Lens) -> np.ndarray:
    """Rays of a fisheye's pixels by inverting its polynomial numerically, [h, w, 3]."""
    f, _, cx, cy, k1 = lens.params[:5]
    x, y = np.meshgrid(np.arange(lens.width) + 0.5 - cx, np.arange(lens.height) + 0.5 - cy)
    radius = np.hypot(x, y) / f
    angle = np.linspace(0, np.pi, 20001)
    found = np.interp(radius, angle * (1 + k1 * angle**2), angle)
    side = np.sin(found) / np.maximum(np.hypot(x, y), 1e-9)
    return np.stack([x * side, y * side, np.cos(found)], -1)


def dual_rays() -> np.ndarray:
    """Two equidistant circles of 200 degrees, the right one of the camera turned about."""
    side = WIDTH // 2
    along = np.arange(side) + 0.5 - side / 2
    x, y = np.meshgrid(along, along)
    angle = np.hypot(x, y) / (side / 2) * np.radians(100.0)
    scale = np.sin(angle) / np.maximum(np.hypot(x, y), 1e-9)
    front = np.stack([x * scale, y * scale, np.cos(angle)], -1)
    return np.concatenate([front, front * [-1, 1, -1]], axis=1)


RAYS = {
    "EQUIRECTANGULAR": panorama_rays,
    "OPENCV_FISHEYE": lambda: fisheye_rays(FISHEYE),
    "DUAL_FISHEYE": dual_rays,
}


def capture_of(
    folder: Path, lens: Lens, rays: np.ndarray, poses: np.ndarray, *, depth: bool = False
) -> PosedImages:
    """Photos of the room through a lens, and transforms.json or the same opened by hand."""
    (folder / "images").mkdir(parents=True)
    paths = []
    for number, pose in enumerate(poses):
        points, distance = walls(pose[:3, 3], rays @ pose[:3, :3].T)
        path = folder / "images" / f"{number:03d}.png"
        Image.fromarray(np.rint(255 * color_of(points)).astype(np.uint8)).save(path)
        if depth:
            np.save(path.with_suffix(".npy"), distance.astype(np.float32))
        paths.append(path)
    depths = tuple(path.with_suffix(".npy") if depth else None for path in paths)
    return PosedImages(folder, tuple(paths), (lens,) * len(paths), poses, depths)


def some_poses(num: int = 3) -> np.ndarray:
    """Level and tilted cameras in the room."""
    rng = np.random.default_rng(3)
    eyes = rng.uniform(0.3 * SIZE, 0.7 * SIZE, (num, 3))
    return np.stack([pose_at(eye, eye + rng.normal(size=3) * [1, 1, 0.2]) for eye in eyes])


def view_rays(images: PosedImages, index: int) -> np.ndarray:
    lens = images.lenses[index]
    fx, fy, cx, cy = lens.intrinsics
    u, v = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    return np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], -1)


@pytest.mark.parametrize("lens", [PANORAMA, FISHEYE, DUAL], ids=lambda lens: lens.model)
@pytest.mark.parametrize("overlap", [0.0, 20.0])
def test_views_show_what_their_rays_meet(tmp_path, lens, overlap):
    rays = RAYS[lens.model]()
    images = cut_wide(capture_of(tmp_path, lens, rays, some_poses(), depth=True), Cut(overlap))
    shown = []
    for index in range(len(images)):
        pose, local = images.poses[index], view_rays(images, index)
        points, distance = walls(pose[:3, 3], local @ pose[:3, :3].T)
        rgb, is_there = images.masked_rgb(index)
        assert is_there is not None
        shown.append(is_there.mean())
        off = np.abs(rgb / 255.0 - color_of(points))[is_there]
        # The nearest pixel is up to 1/40 rad aside, a tenth of which the colors change by.
        assert np.median(off) < 0.01
        assert np.percentile(off, 99.0) < 0.06
        z = images.depth(index)
        assert z is not None
        expected = distance / np.linalg.norm(local, axis=-1)
        assert np.median(np.abs(z / expected - 1.0)[is_there]) < 0.02
        np.testing.assert_array_equal(z[~is_there], 0.0)
    assert max(shown) == 1.0
    number = len(FACES) if lens.is_panorama else 5
    assert len(images) == 3 * number


def test_projection_is_colmaps():
    pycolmap = pytest.importorskip("pycolmap")
    rays = np.random.default_rng(0).normal(size=(200, 3))
    camera = pycolmap.Camera(
        model="EQUIRECTANGULAR", width=WIDTH, height=WIDTH // 2, params=[WIDTH, WIDTH // 2]
    )
    expected = np.asarray(camera.img_from_cam(rays))
    np.testing.assert_allclose(np.stack(project_rays(PANORAMA, rays), 1), expected, atol=1e-6)


@given(st.sampled_from([PANORAMA, FISHEYE, DUAL]), st.integers(0, 2**31))
def test_a_ray_has_the_pixel_whose_ray_it_is(lens, seed):
    rays = RAYS[lens.model]()
    rng = np.random.default_rng(seed)
    row, column = rng.integers(lens.height), rng.integers(lens.width)
    (x,), (y,) = project_rays(lens, rays[row, column][None] * rng.uniform(0.1, 10.0))
    if lens is DUAL and rays[row, column, 2] * (0.5 * WIDTH - column - 0.5) < 0.0:
        return  # the other circle shows this direction nearer to its middle
    if np.isfinite(x):
        np.testing.assert_allclose([x, y], [column + 0.5, row + 0.5], atol=0.02)
    else:
        assert np.hypot(column + 0.5 - 64, row + 0.5 - 64) > 63.0


def with_tracks(images: PosedImages, num: int = 500) -> PosedImages:
    rng = np.random.default_rng(0)
    xyz = rng.uniform(0.0, SIZE, (num, 3))
    point = np.repeat(np.arange(num), len(images))
    points = SparsePoints(
        xyz, np.zeros((num, 3), np.uint8), point, np.tile(np.arange(len(images)), num)
    )
    return PosedImages(
        images.path, images.image_paths, images.lenses, images.poses, images.depth_paths,
        points=points,
    )  # fmt: skip


def test_every_observation_goes_to_the_view_that_shows_it(tmp_path):
    whole = with_tracks(capture_of(tmp_path, PANORAMA, panorama_rays(), some_poses()))
    assert whole.points is not None
    for overlap in (0.0, 20.0):
        images = cut_wide(whole, Cut(overlap))
        points = images.points
        assert points is not None
        assert images.photo_of is not None
        pairs = np.stack([points.seen_point, images.photo_of[points.seen_image]], 1)
        assert len(np.unique(pairs, axis=0)) == len(whole.points.seen_point)
        assert (len(pairs) > len(whole.points.seen_point)) == (overlap > 0.0)
        assert (np.diff(points.seen_point) >= 0).all()
        for point, index in zip(points.seen_point[::50], points.seen_image[::50], strict=True):
            pose, lens = images.poses[index], images.lenses[index]
            x, y, z = pose[:3, :3].T @ (points.xyz[point] - pose[:3, 3])
            fx, fy, cx, cy = lens.intrinsics
            assert z > 0.0
            assert -1e-6 <= fx * x / z + cx <= lens.width + 1e-6
            assert -1e-6 <= fy * y / z + cy <= lens.height + 1e-6


def test_the_cone_below_the_camera_is_masked(tmp_path):
    whole = capture_of(tmp_path, PANORAMA, panorama_rays(), some_poses(1))
    for hidden in (0.0, 25.0):
        images = cut_wide(whole, Cut(hide_below=hidden))
        masks = {path.stem: images.masked_rgb(i)[1] for i, path in enumerate(images.image_paths)}
        for name, mask in masks.items():
            assert mask is not None
            rays = view_rays(images, 0)
            off = np.degrees(np.arctan(np.hypot(rays[..., 0], rays[..., 1])))
            expected = off > hidden if name == "000_down" else np.ones_like(mask)
            assert (mask == expected).mean() > 0.99


def test_masks_of_photos_are_cut_like_them(tmp_path):
    whole = capture_of(tmp_path, PANORAMA, panorama_rays(), some_poses(1))
    right = panorama_rays()[..., 0] > 0.0  # only the right half counts
    Image.fromarray(np.uint8(255) * right).save(tmp_path / "mask.png")
    masked = PosedImages(
        whole.path, whole.image_paths, whole.lenses, whole.poses, whole.depth_paths,
        mask_paths=(tmp_path / "mask.png",),
    )  # fmt: skip
    images = cut_wide(masked, Cut(hide_below=0.0))
    shares = {p.stem: images.masked_rgb(i)[1].mean() for i, p in enumerate(images.image_paths)}
    assert shares["000_right"] == 1.0
    assert shares["000_left"] == 0.0
    assert shares["000_front"] == pytest.approx(0.5, abs=0.03)


def write_transforms(folder: Path, num: int = 4, **more: object) -> Path:
    poses = some_poses(num)
    capture_of(folder, PANORAMA, panorama_rays(), poses)
    frames = [
        {
            "file_path": f"images/{i:03d}.png",
            "transform_matrix": (pose @ OPENGL_FROM_OPENCV).tolist(),
        }
        for i, pose in enumerate(poses)
    ]
    rng = np.random.default_rng(0)
    points = rng.uniform(0.0, SIZE, (2000, 3))
    points[np.arange(2000), rng.integers(3, size=2000)] = 0.0
    write_points(folder / "points.ply", points, np.zeros((2000, 3), np.uint8))
    content = {"camera_model": "EQUIRECTANGULAR", "ply_file_path": "points.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps({**content, **more}))
    return folder


def test_nerfstudios_panoramas_open_as_views_named_after_photo_and_direction(tmp_path):
    source = open_capture(write_transforms(tmp_path)).source
    assert isinstance(source, PosedImages)
    assert [path.name for path in source.image_paths[:6]] == [f"000_{face}.png" for face in FACES]
    assert source.remark is not None
    assert "--hide-below" in source.remark
    audited = source_of(source, "room")
    assert len(audited) == 24
    assert audited.has_images
    np.testing.assert_array_equal(np.unique(audited.some(13) // 6), [0, 3])  # whole photos
    assert len(audited.some(13)) == 12
    rgb, depth = audited.read(0)
    assert rgb.shape[:2] == depth.shape == (audited.camera(0).height, audited.camera(0).width)


def test_a_dual_fisheye_is_told_from_a_panorama(tmp_path):
    folder = write_transforms(tmp_path)
    side = WIDTH // 2
    away = np.hypot(*np.mgrid[0.5 - side / 2 : side / 2, 0.5 - side / 2 : side / 2])
    is_circle = np.tile(away < side / 2, (1, 2))
    for path in (folder / "images").glob("*.png"):
        pixels = np.array(Image.open(path)) * is_circle[..., None]
        Image.fromarray(pixels.astype(np.uint8)).save(path)
    with pytest.raises(FormatError, match="DUAL_FISHEYE"):
        open_capture(folder)
    content = json.loads((folder / "transforms.json").read_text())
    content |= {"camera_model": "DUAL_FISHEYE", "fov": 200}
    (folder / "transforms.json").write_text(json.dumps(content))
    assert len(open_capture(folder)) == 24


def test_a_panorama_that_was_cropped_is_refused(tmp_path):
    with pytest.raises(FormatError, match="256 x 100"):
        open_capture(write_transforms(tmp_path, w=256, h=100))


def test_other_photos_stay_as_they_are(tmp_path):
    lens = Lens("PINHOLE", 64, 48, (40.0, 40.0, 32.0, 24.0))
    narrow = Lens("OPENCV_FISHEYE", 128, 96, (70.0, 70.0, 64.0, 48.0, 0.0, 0.0, 0.0, 0.0))
    assert not is_wide(narrow)
    images = PosedImages(tmp_path, (tmp_path / "a.png",), (lens,), np.eye(4)[None], (None,))
    assert cut_wide(images) is images


@pytest.mark.parametrize("angles", [(-1.0, 0.0), (61.0, 0.0), (0.0, 90.0), (float("nan"), 0.0)])
def test_angles_that_make_no_sense_are_refused(angles):
    with pytest.raises(InputError, match=r"--(overlap-360|hide-below)"):
        Cut(*angles)


def test_a_view_of_the_same_photo_is_no_second_view():
    lens = np.array([40.0, 40.0, 32.0, 24.0])
    gray = np.zeros((48, 64), np.float32)
    pose, moved = np.eye(4), np.eye(4)
    moved[0, 3] = 0.3
    photos = [Photo(gray, lens, pose), Photo(gray, lens, pose.copy()), Photo(gray, lens, moved)]
    points = np.array([[0.0, 0.0, 3.0], [0.2, 0.1, 3.0]])
    chosen = choose_sources(photos, lambda _: points)
    assert [numbers.tolist() for numbers in chosen[:2]] == [[2], [2]]
