"""The ROS 2 node of the examples, without ROS: a bag goes in by its callbacks, goals come out."""

from collections.abc import Iterator

import numpy as np
import pytest

from r3jax.formats.points import voxel_points
from r3jax.formats.ros.bags import Bag
from tests import ros2_stubs
from tests.apps.audit.room import SIZE
from tests.formats.bags import COLOR, DEPTH, Robot, camera_poses, moved, write_bag
from tests.formats.phones import NUM, Z_UP_FROM_ROOM
from tests.formats.rtabmap import T_ROBOT_CAMERA
from tests.test_examples import load

BOUNDS = (0.0, -2.0, 0.5, 3.0, 2.0, 2.9)
"""The room in the map, [m]."""

REMAPPED = {COLOR: "color", DEPTH: "depth", "/camera/color/camera_info": "camera_info"}


@pytest.fixture
def module():
    settings = {"bounds": list(BOUNDS), "motion": "free", "stride": 1, "candidates": 20}
    with ros2_stubs.ros2(**settings, patience=0.1):
        yield load("ros2_node")


def play(node, path) -> Iterator[None]:
    """Sends the messages of a bag, and lets the timer go off after each."""
    bag = Bag(path)
    vector = lambda message, names: np.array([getattr(message, name) for name in names])
    for one in bag.messages(list(bag.types)):
        if one.topic.startswith("/tf"):
            for sample in one.message.transforms:
                stamp = ros2_stubs.Time.from_msg(sample.header.stamp)
                node.tf.tree.add(
                    sample.header.frame_id,
                    sample.child_frame_id,
                    None if one.topic == "/tf_static" else stamp,
                    vector(sample.transform.translation, "xyz"),
                    vector(sample.transform.rotation, "xyzw"),
                )
        elif one.topic in REMAPPED:
            node.callbacks[REMAPPED[one.topic]](one.message)
        node.callbacks["timer"]()
        yield


def path_message(module, poses, times):
    """A trajectory of the robot as a SLAM system publishes it."""
    path = module.Path()
    for pose, time in zip(poses, times, strict=True):
        stamped = module.PoseStamped(pose=module.pose_of(pose))
        stamped.header.stamp.sec = int(time // 1_000_000_000)
        stamped.header.stamp.nanosec = int(time % 1_000_000_000)
        path.poses.append(stamped)
    return path


def xyz_of(cloud) -> np.ndarray:
    """Points [n, 3] of a message."""
    names = [field.name for field in cloud.fields]
    assert names == ["x", "y", "z", "rgb"]
    data = np.frombuffer(bytes(cloud.data), "<f4").reshape(cloud.width, 4)
    return data[:, :3]


@pytest.mark.full
def test_a_bag_goes_in_and_goals_come_out(module, tmp_path):
    node = module.NextViewNode()
    for _ in play(node, write_bag(tmp_path / "drive", Robot(depth="32FC1"))):
        pass
    assert len(node.frames) == NUM
    np.testing.assert_allclose([f.T_world_camera for f in node.frames], camera_poses(), atol=1e-6)
    goals = node.published["goal_pose"].sent
    assert 2 <= len(goals) <= NUM
    for goal in goals:
        assert goal.header.frame_id == "map"
        base = module.matrix_of(goal.pose.position, goal.pose.orientation)
        camera = base @ T_ROBOT_CAMERA
        assert (camera[:3, 3] > np.array(BOUNDS[:3])).all()
        assert (camera[:3, 3] < np.array(BOUNDS[3:])).all()
    np.testing.assert_allclose(camera, node.goal, atol=1e-6)  # a decision is of float32

    line, dots = node.published["next_view"].sent[-1].markers
    end = line.points[-1]
    np.testing.assert_allclose([end.x, end.y, end.z], node.goal[:3, 3], atol=1e-9)
    assert len(dots.points) == len(dots.colors) > 1

    points = np.linalg.inv(Z_UP_FROM_ROOM) @ np.c_[xyz_of(node.published["map_points"].sent[-1]),
                                                   np.ones(len(voxels(node)))].T  # fmt: skip
    to_wall = np.minimum(np.abs(points[:3]), np.abs(SIZE[:, None] - points[:3])).min(axis=0)
    # The voxels' edge; of one depth pixel for nine colors, the outer ones leave the wall.
    assert (to_wall < 0.051).mean() > 0.9
    assert to_wall.max() < 0.3

    closed_loop(module, node)


def voxels(node) -> np.ndarray:
    """Centers of the map's voxels, [n, 3] [m]."""
    return voxel_points(node.planner.map_state)[0]


def closed_loop(module, node):
    """The trajectory moves by one meter: key frames and map move along."""
    robot = [f.T_world_camera @ np.linalg.inv(T_ROBOT_CAMERA) for f in node.frames]
    times = [f.stamp for f in node.frames]
    node.said.clear()
    before, poses = voxels(node), [f.T_world_camera for f in node.frames]
    shift = moved(1.0, 0.0, 0.0)
    node.callbacks["path"](path_message(module, robot, times))
    node.callbacks["path"](path_message(module, [moved(0.01, 0, 0) @ T for T in robot], times))
    assert node.said == []
    np.testing.assert_array_equal(voxels(node), before)
    node.callbacks["path"](path_message(module, [shift @ T for T in robot], times))
    assert node.said == [f"loop closed: mapping {NUM} key frames again"]
    np.testing.assert_allclose(
        [f.T_world_camera for f in node.frames], [shift @ pose for pose in poses], atol=1e-9
    )
    expected = before + np.array([1.0, 0.0, 0.0])
    np.testing.assert_allclose(voxels(node).mean(axis=0), expected.mean(axis=0), atol=0.02)
    assert node.goal is None  # the next timer decides anew


def test_images_wait_for_their_transforms_and_key_frames_for_a_move(module, tmp_path, monkeypatch):
    node = module.NextViewNode()
    added = []
    monkeypatch.setattr(node, "add", lambda frame: (added.append(frame), node.frames.append(frame)))
    monkeypatch.setattr(node, "is_due", lambda: False)
    playing = play(node, write_bag(tmp_path / "drive"))
    while len(added) < 2:
        next(playing)
    assert node.said  # the first pair came before the transform after it
    color, depth = node.pairs.waiting[0][0], node.pairs.waiting[1][0]
    node.last_stamp, node.frames = 0, [added[0]]
    node.callbacks["timer"]()
    node.on_images(color, depth)
    node.callbacks["timer"]()
    assert len(added) == 2  # it has not moved since
    node.on_images(color, depth)
    assert not node.pending  # too soon after the last one


def test_corrections_follow_the_trajectory_and_its_end(module):
    key = lambda stamp: module.KeyFrame(stamp, np.zeros(0), np.zeros(0), np.eye(4))
    second = 1_000_000_000
    times = [0, second]
    before = module.track_of(path_message(module, [np.eye(4), moved(1, 0, 0)], times))
    after = module.track_of(path_message(module, [np.eye(4), moved(1, 0.4, 0)], times))
    frames = module.corrected([key(0), key(second // 2), key(2 * second)], before, after)
    found = [frame.T_world_camera[:3, 3].tolist() for frame in frames]
    np.testing.assert_allclose(found, [[0, 0, 0], [0, 0.2, 0], [0, 0.4, 0]], atol=1e-9)
    empty = module.track_of(module.Path())
    assert module.corrected(frames, empty, after) is frames


def test_goals_of_a_robot_on_the_floor_stand_upright(module):
    tilted = moved(1.0, 2.0, 0.7, yaw=0.5)
    pitch = 0.2
    tilted[:3, :3] = tilted[:3, :3] @ np.array(
        [[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]]
    )
    np.testing.assert_allclose(module.upright(tilted), moved(1.0, 2.0, 0.0, yaw=0.5), atol=1e-12)


def test_a_cloud_packs_its_colors_as_rviz_reads_them(module):
    header = module.Header(frame_id="map")
    points = np.array([[1.0, 2.0, 3.0]], np.float32)
    cloud = module.cloud_of(header, points, np.array([[255, 128, 1]], np.uint8))
    np.testing.assert_array_equal(xyz_of(cloud), points)
    assert int.from_bytes(bytes(cloud.data)[12:16], "little") == (255 << 16) | (128 << 8) | 1
    assert cloud.header.frame_id == "map"
