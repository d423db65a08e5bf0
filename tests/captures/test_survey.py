"""Depth images against poses: a common mistake is found by itself, what is right never is."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation

from r3jax.captures.agreement import DepthImage, check_agreement
from r3jax.captures.settings import SurveySettings
from r3jax.captures.source import Source, ray_lengths, source_of
from r3jax.captures.survey import on_lattice, survey_of
from r3jax.formats.captures import open_capture
from r3jax.formats.recordings import read_recording
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import empty_grid
from tests.apps.audit.room import (
    LENS,
    picture,
    pose_at,
    round_poses,
    write_colmap,
    write_far_recording,
    write_recording,
)
from tests.conftest import shared_path


@given(st.integers(0, 500), st.floats(0.2, 1.7))
def test_grids_of_one_place_have_the_same_cells(seed, cell):
    """A cell of one grid is a cell of the other, whatever box each of them covers."""
    rng = np.random.default_rng(seed)
    low = rng.uniform(-9.0, 9.0, (2, 3))
    boxes = [np.stack([a, a + rng.uniform(0.1, 9.0, 3)]) for a in low]
    a, b = (empty_grid(on_lattice(box, cell), cell) for box in boxes)
    between = (np.asarray(a.origin, np.float64) - np.asarray(b.origin)) / cell
    np.testing.assert_allclose(between, np.round(between), atol=1e-4)
    for box, grid in zip(boxes, (a, b), strict=True):
        assert (np.asarray(grid.origin) <= box[0] + 1e-4).all()
        assert (np.asarray(grid.origin) + cell * np.array(grid.log_odds.shape) >= box[1]).all()


SHOWN = [(picture(pose)[1], pose) for pose in round_poses(16)]


def looks(factor: float = 1.0, turn: np.ndarray | None = None) -> list[DepthImage]:
    turn = np.eye(4) if turn is None else turn
    return [DepthImage(factor * depth, LENS.camera, pose @ turn) for depth, pose in SHOWN]


@pytest.mark.parametrize("factor", [5.0, 0.2, 2.0, 0.5, 1000.0, 0.001])
def test_a_wrong_unit_of_depth_is_refused_and_the_right_one_named(factor):
    with pytest.raises(ValueError, match="multiplied by") as refusal:
        check_agreement(looks(factor))
    assert named_factor(refusal) == pytest.approx(1.0 / factor, rel=0.15)


def named_factor(refusal: pytest.ExceptionInfo[ValueError]) -> float:
    return float(str(refusal.value).partition("multiplied by ")[2].partition(":")[0])


def with_lens(fx: float = 1.0, fy: float = 1.0, dx: float = 0.0, dy: float = 0.0):
    """The same images, as if the lens were another one: factors and shifts in widths."""
    c = LENS.camera
    shift = [float(c.cx) + dx * c.width, float(c.cy) + dy * c.width]
    lens = Camera(c.width, c.height, float(c.fx) * fx, float(c.fy) * fy, *shift)
    return [replace(look, camera=lens) for look in looks()]


def changed(change) -> list[DepthImage]:
    """The same images with other depths."""
    return [replace(look, depth=change(look.depth)) for look in looks()]


def rays(depth: np.ndarray) -> np.ndarray:
    c = LENS.camera
    return depth * ray_lengths(depth.shape, np.array([c.fx, c.fy, c.cx, c.cy], float))


@pytest.mark.parametrize(
    ("images", "named"),
    [
        (changed(rays), "--depth-along-ray"),
        (changed(lambda depth: depth[::-1]), "upside down"),
        (changed(lambda depth: depth[:, ::-1]), "mirrored"),
        (changed(lambda depth: depth[::-1, ::-1]), "180 degrees"),
        (changed(lambda depth: 8.0 / depth), "disparity"),
        (with_lens(1.3, 1.3), "fl_x"),
        (with_lens(0.8, 0.8), "fl_x"),
        (with_lens(dx=0.15), "cx and cy"),
        (with_lens(dx=-0.1, dy=0.1), "cx and cy"),
        (looks(turn=np.diag([1.0, -1.0, -1.0, 1.0])), "axes of all cameras"),
        ([replace(look, pose=np.linalg.inv(look.pose)) for look in looks()], "inverted"),
    ],
)
def test_a_common_mistake_is_named(images, named):
    with pytest.raises(ValueError, match="poses") as refusal:
        check_agreement(images)
    assert named in str(refusal.value)
    assert "--trust-depth" in str(refusal.value)


def test_what_a_focal_length_is_multiplied_by_is_what_it_was_divided_by():
    with pytest.raises(ValueError, match="focal") as refusal:
        check_agreement(with_lens(1.3, 1.3))
    named = [float(x) for x in re.findall(r"(\d\.\d+) \(along", str(refusal.value))]
    assert named == pytest.approx([1.0 / 1.3] * 2, abs=0.06)


def test_what_fits_is_let_through():
    rng = np.random.default_rng(0)
    check_agreement(looks())
    noisy = [look.depth * rng.normal(1.0, 0.01, look.depth.shape) for look in looks()]
    drifted = [pose.copy() for _, pose in SHOWN]
    for pose in drifted:
        pose[:3, 3] += rng.normal(0.0, 0.02, 3)
        pose[:3, :3] = Rotation.from_rotvec(rng.normal(0.0, 0.005, 3)).as_matrix() @ pose[:3, :3]
    holes = [np.where(rng.random(depth.shape) < 0.1, 0.0, depth) for depth in noisy]
    images = [DepthImage(d, LENS.camera, pose) for d, pose in zip(holes, drifted, strict=True)]
    check_agreement(images)
    check_agreement(images[:3])
    check_agreement(images[::4])


def test_where_nothing_can_be_compared_nothing_is_said():
    eye = np.array([2.0, 1.5, 1.2])
    turned = [
        pose_at(eye, eye + np.array([np.cos(a), np.sin(a), 0])) for a in np.arange(0.0, 6.28, 0.4)
    ]
    check_agreement([DepthImage(5.0 * picture(pose)[1], LENS.camera, pose) for pose in turned])
    check_agreement(looks(5.0)[:1])
    check_agreement([DepthImage(0.0 * look.depth, look.camera, look.pose) for look in looks()])


def building(factor: float, across: int = 10) -> Source:
    """Rooms turned at random, side by side: no camera can see what one in another room shows."""
    rooms = np.tile(np.eye(4), (across**2, 1, 1))
    turns = np.random.default_rng(0).normal(0.0, 2.0, (across**2, 3))
    rooms[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    rooms[:, :2, 3] = 20.0 * np.indices((across, across)).reshape(2, -1).T
    poses = (rooms[:, None] @ np.stack([pose for _, pose in SHOWN])).reshape(-1, 4, 4)
    color = np.zeros((*SHOWN[0][0].shape, 3), np.uint8)
    return Source("b", poses, (LENS,) * len(poses), tuple(map(str, range(len(poses)))), "depth",
                  True, np.array([0.0, 0.0, 1.0]), 1,
                  lambda index: (color, factor * SHOWN[index % len(SHOWN)][0]))  # fmt: skip


def test_in_a_building_images_are_compared_with_those_of_the_same_room():
    survey_of(building(1.0), SurveySettings())
    for factor in (0.5, 2.0):
        with pytest.raises(ValueError, match="multiplied by") as refusal:
            survey_of(building(factor), SurveySettings())
        assert named_factor(refusal) == pytest.approx(1.0 / factor, rel=0.15)


def test_a_real_recording_fits_and_five_times_its_depth_does_not():
    source = source_of(read_recording(shared_path("recordings", "hololens_lounge"), "z"), "lounge")
    indices = np.linspace(0, len(source) - 1, 16).astype(int).tolist()
    real = [DepthImage(source.read(i)[1], source.camera(i), source.poses[i]) for i in indices]
    check_agreement(real)
    with pytest.raises(ValueError, match=r"multiplied by 0\.2"):
        check_agreement([DepthImage(5.0 * look.depth, look.camera, look.pose) for look in real])


def test_coordinates_of_utm_lose_an_origin_and_no_digits(tmp_path):
    """float32 would round them to half a meter."""
    far = np.array([500_000.0, 4_600_000.0, 100.0])
    near, source = (
        source_of(read_recording(path, "z"), path.name)
        for path in (
            write_recording(tmp_path / "near", round_poses()),
            write_far_recording(tmp_path / "far", round_poses(), far),
        )
    )
    settings = SurveySettings(voxel_size=0.2)
    one, other = survey_of(near, settings), survey_of(source, settings)
    assert not one.alignment.origin.any()
    assert np.abs(other.alignment.origin - far).max() < 10.0
    shift = (far - other.alignment.origin) * other.alignment.scale
    for index in (0, 5):
        first, second = near.frame(index, one.alignment), source.frame(index, other.alignment)
        np.testing.assert_allclose(
            np.asarray(second.position), np.asarray(first.position) + shift, atol=1e-5
        )
        np.testing.assert_array_equal(second.depth, first.depth)
    back = other.alignment.poses_back(other.alignment.poses(source.poses))
    np.testing.assert_allclose(back[:, :3, 3] - far, near.poses[:, :3, 3], atol=1e-7)


@pytest.mark.parametrize(("orientation", "quarters"), [(1, 0), (6, 1), (3, 2), (8, 3)])
def test_photos_of_a_phone_on_its_side_stand_upright(tmp_path, orientation, quarters):
    """Stored as the sensor reads them; shown, they are turned clockwise by 90 degrees a quarter."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0.0, 0.0, np.pi / 2 * quarters]).as_matrix()
    folder = write_colmap(tmp_path, round_poses(12) @ turn)
    exif = Image.Exif()
    exif[0x0112] = orientation
    for path in (folder / "images").iterdir():
        Image.open(path).save(path, exif=exif)
    survey = survey_of(source_of(open_capture(folder).source, "room"), SurveySettings())
    assert survey.up.direction[2] > np.cos(np.radians(15.0))
