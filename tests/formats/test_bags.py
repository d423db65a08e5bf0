"""ROS bags: what they show lies where the room has its walls, whatever the messages' types."""

import dataclasses
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from r3jax.captures.source import source_of
from r3jax.formats.captures import open_capture
from r3jax.formats.depth import register_depth
from r3jax.formats.errors import FormatError
from r3jax.formats.lenses import Lens
from r3jax.formats.posed_images import PosedImages
from r3jax.formats.ros.bag_reader import read_bag
from r3jax.formats.ros.bags import Topics, parse_topics
from r3jax.formats.ros.messages import depth_of, is_color, lens_of, rgb_of
from r3jax.formats.ros.transforms import TransformTree
from r3jax.frame import read_ahead
from r3jax.validation.errors import ForeignFileError
from tests.formats.bags import (
    COLOR,
    DEPTH,
    DEPTH_OPTICAL,
    OPTICAL,
    SERVICE,
    T_COLOR_DEPTH,
    Robot,
    camera_info,
    camera_poses,
    depth_fields,
    image,
    messages,
    moved,
    packed,
    write_bag,
)
from tests.formats.phones import FACTOR, LENS, NUM, Z_UP_FROM_ROOM, room_poses, smaller, view
from tests.formats.sequences import encoded
from tests.formats.test_phones import JPEG, assert_shows_the_room

LOSSLESS = 1.5
"""Mean error of colors [of 255] that rounding leaves."""


def path_of(tmp_path, kind):
    return tmp_path / ("drive.bag" if kind == "bag" else "drive")


@pytest.mark.parametrize("kind", ["mcap", "db3", "bag", "one mcap", "one db3"])
def test_a_bag_shows_the_room(tmp_path, kind):
    path = write_bag(path_of(tmp_path, kind), kind=kind.removeprefix("one "))
    if kind.startswith("one"):  # without its metadata.yaml
        path = next(path.glob("*.mcap" if "mcap" in kind else "*.db3"))
    capture = open_capture(path)
    assert capture.name == "drive"
    images = capture.source
    assert isinstance(images, PosedImages)
    assert len(images) == NUM
    assert_shows_the_room(images, Z_UP_FROM_ROOM, LOSSLESS)
    np.testing.assert_allclose(images.poses, camera_poses(), atol=1e-6)
    np.testing.assert_array_equal(images.up, [0, 0, 1])
    assert source_of(images, "drive").labels[0] == "1700000000.000000000"
    assert (images.depth(0)[:FACTOR, :FACTOR] == 0).all()


@pytest.mark.parametrize("kind", ["mcap", "db3", "bag"])
def test_a_bag_is_read_in_another_thread_as_well(tmp_path, kind):
    """Audits and selections read ahead."""
    images = open_capture(write_bag(path_of(tmp_path, kind), kind=kind)).source
    assert isinstance(images, PosedImages)
    depths = list(read_ahead(map(images.depth, range(NUM))))
    for number, depth in enumerate(depths):
        np.testing.assert_array_equal(depth, images.depth(number))


@pytest.mark.parametrize(
    "robot",
    [
        Robot(color="bgr8", depth="32FC1"),
        Robot(color="jpeg", depth="compressedDepth 16UC1"),
        Robot(depth="compressedDepth 32FC1"),
        Robot(depth="compressedDepth rvl 16UC1"),
        Robot(pose="odometry"),
        Robot(pose="pose"),
        Robot(color="8UC3"),
        Robot(color="rgb16"),
    ],
    ids=lambda robot: f"{robot.color} {robot.depth} {robot.pose}",
)
def test_other_messages_show_the_same(tmp_path, robot):
    images = read_bag(write_bag(tmp_path / "drive", robot))
    assert len(images) == NUM
    assert_shows_the_room(images, Z_UP_FROM_ROOM, JPEG if robot.color == "jpeg" else LOSSLESS)
    assert (images.depth(0)[:FACTOR, :FACTOR] == 0).all()


@pytest.mark.parametrize("kind", ["mcap", "db3", "bag"])
def test_topics_whose_type_cannot_be_parsed_are_left_out_and_named(tmp_path, kind):
    path = write_bag(path_of(tmp_path, kind), Robot(service=True), kind)
    images = read_bag(path)
    assert len(images) == NUM
    assert_shows_the_room(images, Z_UP_FROM_ROOM, LOSSLESS)
    assert f"{SERVICE}" in images.remark


def test_channels_of_other_languages_in_an_mcap_are_left_out(tmp_path):
    path = next(write_bag(tmp_path / "drive", Robot(service=True)).glob("*.mcap"))
    data = path.read_bytes()
    name = b"AddTwoInts_Event" + (7).to_bytes(4, "little") + b"ros2msg"
    assert name in data
    path.write_bytes(data.replace(name, name.replace(b"ros2msg", b"jsonsch")))
    images = read_bag(path)
    assert len(images) == NUM
    assert SERVICE in images.remark


def test_gray_is_color_where_nothing_else_is(tmp_path):
    images = read_bag(write_bag(tmp_path / "drive", Robot(color="mono8")))
    rgb, gray = images.rgb(0), view(room_poses()[0], LENS)[0][..., 1]
    np.testing.assert_array_equal(rgb, np.repeat(gray[..., None], 3, axis=-1))


@pytest.mark.parametrize("is_bigendian", [0, 1])
def test_a_mosaic_of_16_bits_shows_what_one_of_8_does(is_bigendian):
    raw = np.random.default_rng(0).integers(0, 256, (6, 8)).astype(np.uint8)
    wide = (raw.astype(np.uint16) << 8).astype(">u2" if is_bigendian else "<u2")
    sent = lambda pixels, encoding: SimpleNamespace(
        encoding=encoding, height=6, width=8, step=pixels.strides[0], is_bigendian=is_bigendian,
        data=pixels.tobytes(),
    )  # fmt: skip
    expected = rgb_of(sent(raw, "bayer_rggb8"))
    np.testing.assert_array_equal(rgb_of(sent(wide, "bayer_rggb16")), expected)


def test_a_camera_info_that_was_never_filled_in_says_so():
    info = SimpleNamespace(k=np.zeros(9), d=np.zeros(5), width=8, height=6, distortion_model="")
    with pytest.raises(ForeignFileError, match="--topics info="):
        lens_of(info)


def test_a_package_that_fails_by_itself_is_not_called_missing(tmp_path, monkeypatch):
    path = write_bag(tmp_path / "drive")
    for name in [name for name in sys.modules if name.startswith("rosbags")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "lz4", None)
    monkeypatch.setitem(sys.modules, "lz4.frame", None)
    with pytest.raises(FormatError, match=r"rosbags.*lz4"):
        open_capture(path)


def test_poses_of_a_topic_are_of_the_frame_that_is_named(tmp_path):
    path = write_bag(tmp_path / "drive", Robot(pose="odometry"))
    topics = parse_topics(f"pose=/odom, color={COLOR}")
    assert topics == Topics(color=COLOR, pose="/odom")
    images = open_capture(path, topics=topics).source
    np.testing.assert_allclose(images.poses, camera_poses(), atol=1e-6)
    of_camera = read_bag(path, Topics(pose="/odom", frame=OPTICAL))
    assert not np.allclose(of_camera.poses, camera_poses(), atol=0.1)
    odom = read_bag(write_bag(tmp_path / "other"), Topics(world="odom"))
    assert "camera_color_optical_frame" in odom.remark
    assert not np.allclose(odom.poses, camera_poses(), atol=0.1)


def test_depth_of_a_camera_of_its_own_is_registered(tmp_path):
    path = write_bag(tmp_path / "drive", Robot(registered=False))
    images = read_bag(path)
    assert images.depth_lenses is None
    depth, wanted = images.depth(0), view(room_poses()[0], LENS)[1]
    is_measured = depth > 0
    assert is_measured.mean() > 0.7
    assert (
        np.abs(depth - wanted)[is_measured].mean() < 0.1
    )  # pixels of the depth are 6 degrees wide


def test_registered_depth_lies_on_the_walls():
    """Fine pixels: what is left is the width of a pixel of the result."""
    larger = lambda factor: Lens("PINHOLE", LENS.width * factor, LENS.height * factor, tuple(
        value * factor for value in LENS.params
    ))  # fmt: skip
    fine, lens = larger(8), larger(4)
    pose = room_poses()[0]
    depth = view(pose @ T_COLOR_DEPTH, fine)[1].astype(np.float32)
    found = register_depth(depth, fine, lens, T_COLOR_DEPTH)
    seen = Lens("PINHOLE", found.shape[1], found.shape[0], tuple(
        value * side / whole for value, side, whole in zip(
            lens.params, found.shape[::-1] * 2, (lens.width, lens.height) * 2, strict=True)
    ))  # fmt: skip
    wanted = view(pose, seen)[1]
    off = np.abs(found - wanted)[found > 0]
    assert (found > 0).mean() > 0.9
    assert off.max() < 0.05
    assert off.mean() < 0.005
    assert np.abs(view(pose @ T_COLOR_DEPTH, seen)[1] - wanted).mean() > 0.01
    hidden = register_depth(np.full_like(depth, np.inf), fine, lens, T_COLOR_DEPTH)
    assert (hidden == 0).all()


def without(*topics, **fields):
    return Robot(leave_out=topics, **fields)


DAMAGED = {
    "no depth": (without(DEPTH), "there are no depth images .*only /camera.*record them, too"),
    "no color": (without(COLOR), "there are no color images .rgb8, bgr8, mono8 or JPEG."),
    "no info": (Robot(info=False), f"no camera_info for {COLOR}: record it"),
    "no tf": (
        without("/tf"),
        "camera_color_optical_frame.*camera_link in base_link: record /tf",
    ),
    "no static": (
        without("/tf_static", pose="odometry"),
        f"/odom says where base_link is, .*--topics pose=/odom,frame={OPTICAL}",
    ),
    "clocks": (Robot(depth_delay=0.1), r"of 4 images .* within 0\.02 s \(0 have one\) and a pose"),
    "encoding": (Robot(color="nv21"), "there are no color images"),
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_a_bag_that_lacks_something_says_what_to_record(tmp_path, damage):
    robot, message = DAMAGED[damage]
    path = write_bag(tmp_path / "drive", robot)
    with pytest.raises(FormatError, match=message) as found:
        open_capture(path)
    assert str(path) in str(found.value)


def test_a_bag_of_nothing_that_can_be_read_says_so(tmp_path):
    everything = tuple({sent.topic for sent in messages(Robot())})
    path = write_bag(tmp_path / "drive", Robot(leave_out=everything, service=True))
    with pytest.raises(FormatError, match=r"no color images .* in it, nor any message .* parsed: "):
        open_capture(path)


@pytest.mark.parametrize("lost", [1, 1000])
@pytest.mark.parametrize("kind", ["mcap", "db3", "bag"])
def test_a_bag_that_was_cut_off_says_so(tmp_path, kind, lost):
    path = write_bag(path_of(tmp_path, kind), kind=kind)
    file = path if kind == "bag" else next(path.glob(f"*.{kind}"))
    file.write_bytes(file.read_bytes()[:-lost])
    with pytest.raises(FormatError, match="ros2 bag reindex"):
        open_capture(path)


def test_frames_without_depth_or_pose_are_left_out_and_counted(tmp_path, monkeypatch):
    real = camera_poses()
    monkeypatch.setattr("tests.formats.bags.camera_poses", lambda: real)
    images = read_bag(write_bag(tmp_path / "a"), None)
    assert "left out" not in images.remark
    tree_cut = TransformTree.poses

    def late(self, chain, times):
        poses, known = tree_cut(self, chain, times)
        return poses, known & (np.arange(len(times)) > 0)

    monkeypatch.setattr(TransformTree, "poses", late)
    images = read_bag(tmp_path / "a")
    assert len(images) == NUM - 1
    assert "1 of 4 frames" in images.remark


def test_names_that_a_bag_does_not_have_are_refused(tmp_path):
    path = write_bag(tmp_path / "drive")
    with pytest.raises(FormatError, match=r"/nothing.*\(Image\)"):
        read_bag(path, Topics(color="/nothing"))
    with pytest.raises(FormatError, match=r"/tf .*tf2_msgs/msg/TFMessage"):
        read_bag(path, Topics(color="/tf"))
    with pytest.raises(FormatError, match=r"camera_color_optical_frame.*mars"):
        read_bag(path, Topics(world="mars"))
    with pytest.raises(ValueError, match="kolor=/x"):
        parse_topics("kolor=/x")
    with pytest.raises(FormatError, match="topics"):
        open_capture(tmp_path, topics=Topics())


def test_a_bag_without_rosbags_names_the_extra(tmp_path, monkeypatch):
    path = write_bag(tmp_path / "drive")
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(FormatError, match=r"drive: .*pip install 'r3jax\[ros\]'"):
        open_capture(path)


def test_several_bags_in_a_folder_have_to_be_chosen_from(tmp_path):
    for name in ("monday", "friday"):
        write_bag(tmp_path / f"{name}.bag", kind="bag")
    with pytest.raises(FormatError, match=r"\S+friday"):
        open_capture(tmp_path)


def message(fields):
    """Fields as attributes."""
    if not isinstance(fields, dict):
        return fields
    return SimpleNamespace(**{name: message(value) for name, value in fields.items()})


def test_images_that_cannot_be_right_are_refused():
    pixels = np.zeros((4, 5, 3), np.uint8)
    whole = message(image(pixels, "rgb8", OPTICAL, 0))
    assert rgb_of(whole).shape == (4, 5, 3)
    for change, words in (
        ({"encoding": "nv21"}, "unsupported image encoding 'nv21': rgb8, bgr8"),
        ({"encoding": "yuv422"}, "an odd number of columns"),
        ({"data": whole.data[:30]}, "5 x 4 pixels and 20 bytes a row has 30 bytes"),
        ({"step": 14}, "14 bytes a row"),
        ({"width": 1 << 20, "height": 1 << 20}, "an image has 1048576 x 1048576 pixels"),
    ):
        with pytest.raises(ForeignFileError, match=words):
            rgb_of(SimpleNamespace(**{**vars(whole), **change}))
    fields = depth_fields(room_poses()[0], Robot(depth="compressedDepth 16UC1"), smaller(), "", 0)
    with pytest.raises(ForeignFileError):
        depth_of(message(fields | {"data": b"123"}))


@pytest.mark.parametrize("order", ["rggb", "bggr", "gbrg", "grbg"])
def test_a_mosaic_shows_its_colors(order):
    rng = np.random.default_rng(0)
    smooth = np.add.outer(np.arange(8) * 4.0, np.arange(10) * 7.0)[..., None] + [20.0, 60.0, 100.0]
    raw = np.zeros((8, 10), np.uint8)
    for at, name in enumerate(order):
        part = slice(at // 2, None, 2), slice(at % 2, None, 2)
        raw[part] = smooth[(*part, "rgb".index(name))]
    found = rgb_of(message(image(raw, f"bayer_{order}8", OPTICAL, 0)))
    np.testing.assert_allclose(found[1:-1, 1:-1], smooth[1:-1, 1:-1], atol=0.51)  # a plane stays
    noise = rng.integers(0, 256, (6, 6), dtype=np.uint8)
    packed_as_png = packed(encoded(noise), f"bayer_{order}8; png compressed", OPTICAL, 0)
    np.testing.assert_array_equal(
        rgb_of(message(packed_as_png)), rgb_of(message(image(noise, f"bayer_{order}8", "", 0)))
    )


@pytest.mark.parametrize("encoding", ["uyvy", "yuyv", "yuv422", "yuv422_yuy2"])
def test_yuv_shows_its_colors(encoding):
    """BT.601's own numbers of pure colors."""
    colors = {(255, 0, 0): (81, 90, 240), (0, 255, 0): (145, 54, 34), (0, 0, 255): (41, 240, 110),
              (255, 255, 255): (235, 128, 128), (0, 0, 0): (16, 128, 128)}  # fmt: skip
    rows = []
    for y, u, v in colors.values():
        rows.append([u, y, v, y] if encoding in ("uyvy", "yuv422") else [y, u, y, v])
    fields = image(np.array(rows, np.uint8), encoding, OPTICAL, 0) | {"width": 2}
    assert is_color(message(fields))
    np.testing.assert_allclose(
        rgb_of(message(fields)), np.repeat(np.array(list(colors))[:, None], 2, axis=1), atol=2.0
    )


def test_gray_is_shown_where_it_is_named_and_never_chosen():
    gray = message(image(np.arange(12, dtype=np.uint8).reshape(3, 4), "mono8", OPTICAL, 0))
    assert not is_color(gray)
    np.testing.assert_array_equal(rgb_of(gray)[..., 2], np.arange(12).reshape(3, 4))


def test_depth_of_the_other_byte_order_and_infinity():
    steps = np.array([[0, 1500]], np.uint16)
    swapped = message(image(steps.astype(">u2"), "16UC1", OPTICAL, 0) | {"is_bigendian": 1})
    np.testing.assert_array_equal(depth_of(swapped), np.float32([[0, 1.5]]))
    meters = np.array([[np.nan, -np.inf, -1.0, 0.0, 2.5, np.inf]], np.float32)
    found = depth_of(message(image(meters, "32FC1", OPTICAL, 0)))
    np.testing.assert_array_equal(found, np.float32([[0, 0, 0, 0, 2.5, np.inf]]))  # REP 118


def test_lenses_of_camera_info():
    info = camera_info(LENS, OPTICAL, 0)
    assert lens_of(message(info)) == LENS
    bent = message(info | {"d": np.array([0.1, 0.2, 0.3, 0.4, 0.0])})
    assert lens_of(bent) == dataclasses.replace(
        LENS, model="OPENCV", params=(*LENS.params, 0.1, 0.2, 0.3, 0.4)
    )
    assert lens_of(bent, is_rectified=True) == LENS
    full = lens_of(message(info | {"d": np.array([0.1, 0.2, 0.3, 0.4, 0.5])}))
    assert full.distortion["k3"] == 0.5
    with pytest.raises(ForeignFileError, match="'bubble'"):
        lens_of(message(info | {"d": np.ones(5), "distortion_model": "bubble"}))


def test_transforms_are_interpolated_and_never_guessed():
    tree, second = TransformTree(), 1_000_000_000
    half_turn, none = np.array([0.0, 0.0, 1.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0])
    tree.add("map", "base", 0, np.zeros(3), none)
    tree.add("map", "base", second, np.array([2.0, 0.0, 0.0]), np.array([0, 0, 0.5**0.5, 0.5**0.5]))
    tree.add("map", "base", 9 * second, np.zeros(3), half_turn)
    tree.add("map", "base", 2, np.full(3, np.nan), none)  # passed over
    tree.add("map", "base", 3, np.zeros(3), np.zeros(4))
    tree.add("base", "camera", None, np.array([0.0, 0.0, 1.0]), none)
    tree.add("camera", "camera", None, np.zeros(3), none)
    chain = tree.chain("camera")
    assert chain == ["camera", "base", "map"]
    times = np.array([-1, 0, second // 2, second, 4 * second, 10 * second])
    poses, known = tree.poses(chain, times)
    assert known.tolist() == [True, True, True, True, False, False]
    np.testing.assert_allclose(poses[2], moved(1.0, 0.0, 1.0, yaw=np.pi / 4), atol=1e-9)
    np.testing.assert_allclose(poses[3], moved(2.0, 0.0, 1.0, yaw=np.pi / 2), atol=1e-9)
    tree.add("camera", "map", None, np.zeros(3), none)  # a circle has an end
    assert tree.chain("camera") == ["camera", "base", "map"]
    assert DEPTH_OPTICAL not in tree.edges


def test_a_transform_that_is_repeated_does_not_move():
    tree, none = TransformTree(), np.array([0.0, 0.0, 0.0, 1.0])
    for time in (1, 2, 3):
        tree.add("base", "camera", time, np.ones(3), none)
    assert tree.is_timed(["camera", "base"])
    assert not tree.is_moving(["camera", "base"])
    tree.add("base", "camera", 4, np.array([1.0, 1.0, 1.1]), none)
    assert tree.is_moving(["camera", "base"])
    assert not tree.is_moving(["base"])
