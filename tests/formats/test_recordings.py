"""Recordings: a folder of pictures becomes frames in a world whose z is up."""

import numpy as np
import pytest
from PIL import Image

from r3jax.formats.errors import FormatError
from r3jax.formats.recordings import is_recording, read_recording
from r3jax.geometry.cameras import rigid_error

SIZE = (10, 8)


def turn_about_y(angle: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = [
        [np.cos(angle), 0, np.sin(angle)],
        [0, 1, 0],
        [-np.sin(angle), 0, np.cos(angle)],
    ]
    return pose


def make_poses(num: int = 3) -> np.ndarray:
    # In a y-up world a level OpenCV camera has its y axis (down) along -y.
    level = np.diag([1.0, -1.0, -1.0, 1.0])
    poses = np.stack([turn_about_y(0.4 * i) @ level for i in range(num)])
    poses[:, :3, 3] = np.arange(3 * num).reshape(num, 3) * 0.1
    return poses


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "capture"
    for name in ("images", "depth"):
        (path / name).mkdir(parents=True)
    rng = np.random.default_rng(0)
    for i in range(3):
        rgb = rng.integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
        Image.fromarray(rgb).save(path / "images" / f"{i:03d}.png")
        depth = rng.integers(1, 5000, SIZE[::-1]).astype(np.uint16)
        depth[0, 0] = 0
        Image.fromarray(depth).save(path / "depth" / f"{i:03d}.png")
    np.savetxt(path / "K.txt", [[8.0, 0, 4.5], [0, 8.0, 3.5], [0, 0, 1]])
    np.savetxt(path / "poses.txt", make_poses().reshape(3, 16))
    return path


def test_pixels_meters_and_intrinsics(folder):
    recording = read_recording(folder)
    assert len(recording) == 3
    frame = recording.frame(1)
    rgb = np.asarray(Image.open(folder / "images" / "001.png"))
    depth = np.asarray(Image.open(folder / "depth" / "001.png"))
    np.testing.assert_array_equal(np.rint(np.asarray(frame.rgb) * 255), rgb)
    np.testing.assert_allclose(frame.depth, depth / 1000.0, rtol=1e-6)
    assert frame.depth[0, 0] == 0.0
    assert (frame.camera.width, frame.camera.height) == SIZE
    assert float(frame.camera.cx) == 5.0  # OpenCV counts from the first pixel's center


def test_the_world_is_turned_so_that_z_is_up(folder):
    recording = read_recording(folder, up="y")
    original = make_poses()
    for pose, before in zip(recording.poses, original, strict=True):
        assert rigid_error(pose) is None
        np.testing.assert_allclose(pose[:3, 1], [0, 0, -1], atol=1e-12)  # image rows go down
        x, y, z = before[:3, 3]
        np.testing.assert_allclose(pose[:3, 3], [x, -z, y])
    np.testing.assert_allclose(read_recording(folder, up="z").poses, original, atol=1e-12)


def test_a_small_drift_of_a_rotation_is_mended(folder):
    poses = make_poses()
    poses[1, :3, :3] *= 1.004
    np.savetxt(folder / "poses.txt", poses.reshape(3, 16))
    recording = read_recording(folder, up="z")
    assert rigid_error(recording.poses[1]) is None
    np.testing.assert_allclose(recording.poses[1], make_poses()[1], atol=1e-9)


@pytest.mark.parametrize("gone", ["images/000.png", "images/002.png", "depth/001.png"])
def test_the_others_keep_their_poses_where_a_file_was_deleted(folder, gone):
    number = int(gone[-5])
    before = read_recording(folder)
    (folder / gone).unlink()
    after = read_recording(folder)
    np.testing.assert_array_equal(after.poses, before.poses)
    for index in range(3):
        if index != number:
            found, expected = (np.asarray(r.frame(index).rgb) for r in (after, before))
            np.testing.assert_array_equal(found, expected)
    with pytest.raises(FormatError, match=f"{gone[-7:]}"):
        after.frame(number)


def test_an_image_of_another_size_is_named_when_it_is_read(folder):
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(folder / "images" / "002.png")
    recording = read_recording(folder)
    recording.frame(0)
    with pytest.raises(FormatError, match=r"002\.png.*4 x 4"):
        recording.frame(2)


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(FormatError):
        read_recording(tmp_path / "nowhere")
    assert not is_recording(tmp_path)


def test_the_real_recording_is_upright(shared):
    recording = read_recording(shared("recordings", "hololens_lounge"), up="y")
    assert len(recording) == 48
    assert is_recording(recording.path)
    assert (recording.lenses[0].width, recording.lenses[0].height) == (540, 360)
    # Carried by hand: on average the image's rows point down and the eye stays at one height.
    assert recording.poses[:, 2, 1].mean() < -0.8
    assert np.ptp(recording.poses[:, 2, 3]) < 0.5 < np.ptp(recording.poses[:, 0, 3])
    holes = [float((np.asarray(recording.frame(i).depth) == 0).mean()) for i in (0, 20, 40)]
    assert 0.2 < np.mean(holes) < 0.6
