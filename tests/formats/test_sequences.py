"""Replica-SLAM, TUM, 7-Scenes and LLFF: pixels, meters, poses and intrinsics as their pages say."""

import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from r3jax.formats.captures import open_capture
from r3jax.formats.errors import FormatError
from r3jax.formats.lenses import Lens
from r3jax.formats.sequences.llff import is_llff, read_llff
from r3jax.formats.sequences.replica_slam import is_replica_slam, read_replica_slam
from r3jax.formats.sequences.seven_scenes import is_seven_scenes, read_seven_scenes
from r3jax.formats.sequences.tum import is_tum, nearest, read_tum
from tests.formats import sequences
from tests.formats.sequences import HEIGHT, NUM, WIDTH, pixels, poses
from tests.fuzz.tree import lay_out

READERS = {
    "replica_slam": (is_replica_slam, read_replica_slam),
    "tum": (is_tum, read_tum),
    "seven_scenes": (is_seven_scenes, read_seven_scenes),
    "llff": (is_llff, read_llff),
}


@pytest.fixture(params=READERS)
def name(request):
    return request.param


@pytest.fixture
def folder(tmp_path, name):
    path = tmp_path / name
    lay_out(path, getattr(sequences, name)())
    return path


def test_each_is_told_from_the_others(folder, name):
    for other, (fits, _) in READERS.items():
        assert fits(folder) == (other == name)
        assert not fits(folder / "nowhere")
    capture = open_capture(folder)
    images = READERS[name][1](folder)
    assert capture.source.image_paths == images.image_paths
    assert len(capture) == len(images)


def test_poses_are_camera_to_world_in_opencv_axes(folder, name):
    images = READERS[name][1](folder)
    np.testing.assert_allclose(images.poses, poses(len(images)), atol=2e-7)


def test_replica_slam_has_its_own_scale_and_its_pixels_count_from_their_centers(tmp_path):
    lay_out(tmp_path / "room0", sequences.replica_slam())
    images = read_replica_slam(tmp_path / "room0")
    assert len(images) == NUM
    _, steps = pixels(1)
    np.testing.assert_allclose(images.depth(1), steps / 6553.5, rtol=1e-6)
    assert images.lenses[0].params == (8.0, 8.0, 5.0, 4.0)
    assert images.frame(1).rgb.shape == (HEIGHT, WIDTH, 3)


def test_the_camera_of_replica_slam_may_lie_beside_the_scene(tmp_path):
    lay_out(tmp_path / "room0", sequences.replica_slam())
    (tmp_path / "room0" / "cam_params.json").rename(tmp_path / "cam_params.json")
    assert read_replica_slam(tmp_path / "room0").lenses[0].width == WIDTH


def test_tum_joins_by_time_and_leaves_out_what_has_no_partner(tmp_path):
    lay_out(tmp_path, sequences.tum())
    images = read_tum(tmp_path)
    assert len(images) == NUM  # the last image has no depth
    assert [p.name for p in images.image_paths] == [f"100.{i}00000.png" for i in range(NUM)]
    rgb, steps = pixels(2)
    np.testing.assert_array_equal(images.rgb(2), rgb)
    np.testing.assert_allclose(images.depth(2), steps / 5000.0, rtol=1e-6)


def test_tum_without_k_takes_the_benchmarks_camera_for_its_own_size_only(tmp_path):
    files = sequences.tum()
    del files["K.txt"]
    lay_out(tmp_path, files)
    with pytest.raises(FormatError, match=r"K\.txt.*10x8"):
        read_tum(tmp_path)
    large = sequences.encoded(np.zeros((480, 640, 3), np.uint8))
    lay_out(tmp_path, files | {n: large for n in files if n.startswith("rgb/")})
    assert read_tum(tmp_path).lenses[0].params == (525.0, 525.0, 320.0, 240.0)


def test_seven_scenes_may_have_its_colors_as_jpeg(tmp_path):
    files = sequences.seven_scenes()
    rgb = np.asarray(Image.open(io.BytesIO(files.pop("frame-000001.color.png"))))
    lay_out(tmp_path, {**files, "frame-000001.color.jpg": sequences.encoded(rgb, "jpeg")})
    images = read_seven_scenes(tmp_path)
    assert [path.suffix for path in images.image_paths] == [".png", ".jpg"]
    assert np.abs(images.rgb(1).astype(int) - rgb).mean() < 10.0
    np.testing.assert_allclose(images.poses, poses(2), atol=2e-7)


def test_seven_scenes_may_shout_its_suffixes(tmp_path):
    files = sequences.seven_scenes()
    shouted = {n.replace("color.png", "color.PNG"): data for n, data in files.items()}
    lay_out(tmp_path, shouted)
    images = open_capture(tmp_path).source
    assert [path.name for path in images.image_paths] == [
        "frame-000000.color.PNG", "frame-000001.color.PNG",
    ]  # fmt: skip
    np.testing.assert_array_equal(images.rgb(0)[30::60, 32::64], pixels(0)[0])


def test_seven_scenes_has_two_numbers_for_no_measurement(tmp_path):
    lay_out(tmp_path, sequences.seven_scenes())
    images = read_seven_scenes(tmp_path)
    depth = images.frame(0).depth
    _, steps = pixels(0)
    assert depth.shape == (480, 640)
    assert not np.isinf(depth).any()
    np.testing.assert_array_equal(np.asarray(depth)[30, [32, 96]], 0.0)
    np.testing.assert_allclose(np.asarray(depth)[30::60, 32::64][1:], steps[1:] / 1000, rtol=1e-6)
    assert images.lenses[0].params == (585.0, 585.0, 320.0, 240.0)


def test_llff_has_one_image_for_each_pose(tmp_path):
    lay_out(tmp_path, sequences.llff())
    images = read_llff(tmp_path)
    assert images.lenses[0] == Lens("PINHOLE", WIDTH, HEIGHT, (8.0, 8.0, WIDTH / 2, HEIGHT / 2))
    (tmp_path / "images" / "IMG_9700.JPG").unlink()
    smaller = open_capture(tmp_path).source
    assert smaller.image_paths[1] == tmp_path / "images_2" / "IMG_9700.png"
    assert smaller.lenses[1].intrinsics == (4.0, 4.0, WIDTH / 4, HEIGHT / 4)
    (tmp_path / "images_2" / "IMG_9700.png").unlink()
    with pytest.raises(FormatError, match=r"3 poses, but .*images has 2, .*images_2 has 2"):
        read_llff(tmp_path)


@pytest.mark.parametrize("damage", ["shape", "nan", "focal"])
def test_llff_that_is_damaged_is_refused(tmp_path, damage):
    files = sequences.llff()
    table = np.load(io.BytesIO(files["poses_bounds.npy"]))
    table = table[:, :15] if damage == "shape" else table
    table[1, 14 if damage == "focal" else 2] = np.nan if damage == "nan" else 0.0
    stored = io.BytesIO()
    np.save(stored, table)
    lay_out(tmp_path, files | {"poses_bounds.npy": stored.getvalue()})
    with pytest.raises(FormatError, match=r"poses_bounds\.npy"):
        read_llff(tmp_path)


times = hnp.arrays(np.float64, st.integers(1, 12), elements=st.floats(0, 1, width=32))


@given(times, times, st.floats(0.0, 0.5))
def test_the_nearest_in_time_is_taken_unless_it_is_too_far(asked, others, gap):
    found = nearest(asked, others, gap)
    distance = np.abs(asked[:, None] - others[None])
    for i, j in enumerate(found):
        least = distance[i].min()
        if j < 0:
            assert least > gap
        else:
            assert distance[i, j] == least <= gap


@pytest.mark.parametrize("kind", ["replica_slam", "tum"])
def test_up_is_z_unless_the_world_is_the_first_cameras(tmp_path, kind):
    files, read = getattr(sequences, kind)(), READERS[kind][1]
    lay_out(tmp_path / "theirs", files)
    np.testing.assert_array_equal(read(tmp_path / "theirs").up, [0, 0, 1])
    name, still = {
        "replica_slam": ("traj.txt", lambda line: " ".join(map(str, np.eye(4).ravel()))),
        "tum": ("groundtruth.txt", lambda line: f"{line.split()[0]} 0 0 0 0 0 0 1"),
    }[kind]
    lines = files[name].decode().splitlines()
    files[name] = "\n".join(still(line) for line in lines if line[0] != "#").encode()
    lay_out(tmp_path / "r3", files)
    assert read(tmp_path / "r3").up is None
