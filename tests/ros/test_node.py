"""The ROS 2 node, without ROS: a bag goes in by its callbacks, goals come out."""

import importlib
from collections.abc import Iterator
from concurrent.futures import wait

import jax
import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import r3jax
from r3jax.formats.points import voxel_points
from r3jax.formats.ros.bags import Bag
from r3jax.formats.ros.transforms import TransformTree
from tests.apps.audit.room import SIZE
from tests.formats.bags import COLOR, DEPTH, Robot, camera_poses, moved, write_bag
from tests.formats.phones import NUM, Z_UP_FROM_ROOM
from tests.formats.rtabmap import T_ROBOT_CAMERA
from tests.rooms_of_boxes import pose_at
from tests.ros import stubs

BOUNDS = (0.0, -2.0, 0.5, 3.0, 2.0, 2.9)
"""The room in the map, [m]."""

REMAPPED = {COLOR: "color", DEPTH: "depth", "/camera/color/camera_info": "camera_info"}


@pytest.fixture
def module(tmp_path):
    settings = {
        "map_file": str(tmp_path / "map"),
        "bounds": list(BOUNDS),
        "motion": "free",
        "stride": 1,
        "candidates": 20,
    }
    with stubs.ros2(**settings, patience=0.4):
        yield importlib.import_module("r3jax_ros.node")


def play(node, path) -> Iterator[None]:
    """Sends the messages of a bag, and lets the timer go off after each."""
    bag = Bag(path)
    vector = lambda message, names: np.array([getattr(message, name) for name in names])
    for one in bag.messages(list(bag.types)):
        if one.topic.startswith("/tf"):
            for sample in one.message.transforms:
                stamp = stubs.Time.from_msg(sample.header.stamp)
                node.tf.tree.add(
                    sample.header.frame_id,
                    sample.child_frame_id,
                    None if one.topic == "/tf_static" else stamp,
                    vector(sample.transform.translation, "xyz"),
                    vector(sample.transform.rotation, "xyzw"),
                )
        elif one.topic in REMAPPED:
            node.time = one.time
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
    node = module.ExplorerNode()
    for _ in play(node, write_bag(tmp_path / "drive", Robot(depth="32FC1"))):
        pass
    node.time += 1_000_000_000  # nobody drives: the last goal is late
    node.callbacks["timer"]()
    assert len(node.frames) == NUM
    np.testing.assert_allclose([f.T_world_camera for f in node.frames], camera_poses(), atol=1e-6)
    goals = node.published["next_goal"].sent
    assert 2 <= len(goals) <= NUM + 1
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
    saved_and_loaded(node)


def saved_and_loaded(node):
    """The services write the planner and read it back."""
    before, place = voxels(node), node.frames[-1].T_world_camera
    for name in ("save", "load"):
        answer = node.ask(f"~/{name}")
        assert answer.success, answer.message
    np.testing.assert_array_equal(voxels(node), before)
    assert not node.frames
    node.callbacks["timer"]()  # nothing to decide on yet
    decision, _, _ = r3jax.decide(node.planner, place, jax.random.key(0))
    assert decision is not None


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
    node.callbacks["path"](path_message(module, robot, [0] * len(times)))
    assert "stamp of its own time" in node.said.pop()
    node.callbacks["path"](path_message(module, robot, times))
    node.callbacks["path"](path_message(module, [moved(0.01, 0, 0) @ T for T in robot], times))
    assert node.said == []
    np.testing.assert_array_equal(voxels(node), before)
    node.callbacks["path"](path_message(module, [shift @ T for T in robot], times))
    assert node.said == [f"loop closed: mapping {NUM} key frames again"]
    assert node.goal is None  # the next timer decides anew
    corner = costmap_message(module, np.full((1, 1), 100, np.int8), 0.3, *BOUNDS[:2])
    node.on_costmap(corner)
    node.decide()  # the planner of before gets it, and the new one, too
    wait([node.rebuilding[0]])
    node.swap()
    node.decide()
    assert node.planner.grid.closed.any()
    np.testing.assert_allclose(
        [f.T_world_camera for f in node.frames], [shift @ pose for pose in poses], atol=1e-9
    )
    expected = before + np.array([1.0, 0.0, 0.0])
    np.testing.assert_allclose(voxels(node).mean(axis=0), expected.mean(axis=0), atol=0.02)


def test_images_wait_for_their_transforms_and_key_frames_for_a_move(module, tmp_path, monkeypatch):
    node = module.ExplorerNode()
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


def test_an_image_whose_transforms_will_never_come_is_dropped(module, monkeypatch):
    node, place = module.ExplorerNode(), {"late": None, "early": None, "placed": np.eye(4)}
    frame = lambda T: module.KeyFrame(0, np.zeros(0), np.zeros(0), T)
    known = lambda name: None if place[name] is None else frame(place[name])
    monkeypatch.setattr(node, "key_frame", lambda color, depth: known(color))
    monkeypatch.setattr(node, "add", node.frames.append)
    node.running = False
    node.pending.extend((name, None) for name in ("early", "placed", "late"))
    node.callbacks["timer"]()
    assert len(node.frames) == 1
    assert [color for color, _ in node.pending] == ["late"]
    place["late"] = moved(1.0, 0.0, 0.0)
    node.callbacks["timer"]()
    assert len(node.frames) == 2
    assert not node.pending


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


@given(gaps=st.lists(st.floats(0.1, 300.0), min_size=4, max_size=8), closes=st.integers(2, 3))
def test_a_path_that_grows_closes_its_loop_however_sparse(gaps, closes):
    """SLAM adds a node now and then, and moves all but the first ones when it closes a loop."""
    with stubs.ros2():
        trajectory = importlib.import_module("r3jax_ros.trajectory")
    times = (np.cumsum([0.0, *gaps]) * 1e9).astype(np.int64)
    at_rest = np.array([0.0, 0.0, 0.0, 1.0])

    def path(num: int, shift: float = 0.0) -> TransformTree:
        tree = TransformTree()
        for i, time in enumerate(times[:num]):
            place = np.array([float(i), shift * (i >= closes), 0.0])
            tree.add("world", "robot", int(time), place, at_rest)
        return tree

    track = path(2)
    for num in range(3, len(times) + 1):
        track = trajectory.with_later(track, path(num))
    stamps = np.sort(np.concatenate([times, (times[1:] + times[:-1]) // 2]))
    frames = [trajectory.KeyFrame(int(t), np.zeros(0), np.zeros(0), np.eye(4)) for t in stamps]
    for frame in trajectory.corrected(frames, track, path(len(times), 1.0)):
        x, y, z = frame.T_world_camera[:3, 3]
        share = np.interp(frame.stamp, times[closes - 1 : closes + 1], [0.0, 1.0])
        np.testing.assert_allclose([x, y, z], [0.0, share, 0.0], atol=1e-6)


_angle = st.floats(-180.0, 180.0)


@given(
    st.tuples(st.floats(-5, 5), st.floats(-5, 5), _angle),
    st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(0.1, 1.5)),
    st.tuples(_angle, st.floats(-85.0, 85.0), _angle),
)
def test_a_planar_robot_stands_where_its_camera_has_the_view(place, mount, look):
    """Off-center, tilted, turned and rolled: the base is found again from the camera's pose."""
    with stubs.ros2():
        trajectory = importlib.import_module("r3jax_ros.trajectory")
    T_world_base = moved(*place[:2], 0.0, yaw=np.deg2rad(place[2]))
    T_base_camera = pose_at(mount, *look[:2])
    roll = np.eye(4)
    roll[:3, :3] = Rotation.from_euler("z", look[2], degrees=True).as_matrix()
    T_base_camera = T_base_camera @ roll
    wanted = T_world_base @ T_base_camera @ np.linalg.inv(roll)  # a view of the planner has no roll
    found = trajectory.base_for_view(wanted, T_base_camera)
    np.testing.assert_allclose(found, T_world_base, atol=1e-5)


@pytest.fixture
def driven(module, monkeypatch):
    """A node, and Nav2's side of its goals; nothing is mapped."""
    node = module.ExplorerNode()
    pose = lambda x: module.PoseStamped(pose=module.pose_of(moved(x, 0.0, 0.0)))
    return node.navigator, node.nav2, pose


def test_a_goal_is_followed_to_its_end(driven):
    navigator, nav2, pose = driven
    navigator.go(pose(1.0))
    assert navigator.state == "waiting"
    nav2.sent[0].accept()
    nav2.sent[0].drive(0.7)
    assert (navigator.state, navigator.remaining, navigator.recoveries) == ("driving", 0.7, 1)
    nav2.sent[0].end(4)
    assert (navigator.state, navigator.is_busy) == ("arrived", False)
    assert not nav2.sent[0].is_canceled


@pytest.mark.parametrize("status", [5, 6])
def test_a_goal_that_nav2_gives_up_has_failed(driven, status):
    navigator, nav2, pose = driven
    navigator.go(pose(1.0))
    nav2.sent[0].accept()
    nav2.sent[0].end(status)
    assert navigator.state == "failed"


def test_a_refused_goal_has_failed(driven):
    navigator, nav2, pose = driven
    navigator.go(pose(1.0))
    nav2.sent[0].accept(False)
    assert navigator.state == "failed"


@pytest.fixture
def deciding(module, monkeypatch):
    """A node that has mapped a key frame and sends the same goal each time; its decisions."""
    node = module.ExplorerNode()
    node.frames.append(module.KeyFrame(0, np.zeros(0), np.zeros(0), np.eye(4)))
    node.has_news, decided = True, []

    def decide():
        decided.append(node.navigator.state)
        node.has_news, node.goal, node.goal_time = False, moved(1.0, 0.0, 0.0), node.time
        node.navigator.go(module.PoseStamped(pose=module.pose_of(node.goal)))

    monkeypatch.setattr(node, "decide", decide)
    return node, decided


def test_without_nav2_nothing_is_decided_until_it_is_up(deciding):
    node, decided = deciding
    node.nav2.is_ready = False
    node.callbacks["timer"]()
    assert not decided
    assert "is Nav2 running?" in node.said[0]
    node.nav2.is_ready = True
    node.callbacks["timer"]()
    assert decided == ["idle"]


def test_a_robot_that_stands_still_gets_another_goal_where_the_one_before_failed(deciding):
    node, decided = deciding
    node.callbacks["timer"]()
    node.nav2.sent[0].accept(False)
    node.callbacks["timer"]()
    assert decided == ["idle", "failed"]
    node.nav2.sent[1].accept()
    node.time = 300_000_000
    node.callbacks["timer"]()
    assert len(decided) == 2
    node.time = 500_000_000  # longer than it has patience, by the clock: no image tells of it
    node.callbacks["timer"]()
    assert decided == ["idle", "failed", "failed"]
    assert node.nav2.sent[1].is_canceled


def test_at_a_goal_the_camera_has_turned_to_its_view(module, deciding):
    node, decided = deciding
    node.callbacks["timer"]()
    node.nav2.sent[0].accept()
    near = lambda yaw: moved(0.9, 0.0, 0.0) @ turned(yaw)
    for yaw, num in ((60.0, 1), (10.0, 2)):
        node.frames.append(module.KeyFrame(0, np.zeros(0), np.zeros(0), near(yaw)))
        node.has_news = True
        node.callbacks["timer"]()
        assert len(decided) == num


def turned(degrees: float) -> np.ndarray:
    """A camera that looks to the side."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    return T


@pytest.mark.parametrize("is_accepted_before", [True, False])
def test_a_new_goal_cancels_the_one_before_whatever_comes_of_it(driven, is_accepted_before):
    navigator, nav2, pose = driven
    navigator.go(pose(1.0))
    first = nav2.sent[0]
    if is_accepted_before:
        first.accept()
    navigator.go(pose(2.0))
    if not is_accepted_before:
        first.accept()
    assert first.is_canceled
    second = nav2.sent[1]
    second.accept()
    first.drive(9.0)
    first.end(5)
    assert (navigator.state, navigator.remaining) == ("driving", None)
    navigator.cancel()
    assert second.is_canceled
    assert navigator.state == "idle"


def costmap_message(module, cost: np.ndarray, resolution: float, x: float, y: float):
    message = module.OccupancyGrid(data=cost.ravel().tolist())
    message.header.frame_id = "map"
    message.info.height, message.info.width = cost.shape
    message.info.resolution = resolution
    message.info.origin.position.x, message.info.origin.position.y = x, y
    message.info.origin.orientation.w = 1.0
    return message


def test_a_costmap_is_read_where_its_cells_are(module):
    cost = np.array([[0, 50, 100], [-1, 99, 10]], np.int8)
    costmap = module.Costmap(costmap_message(module, cost, 0.5, -1.0, 2.0))
    rows, columns = np.indices(cost.shape)
    centers = np.stack([-1.0 + 0.5 * (columns + 0.5), 2.0 + 0.5 * (rows + 0.5)], axis=-1)
    np.testing.assert_array_equal(costmap.at(centers.reshape(-1, 2)), cost.ravel())
    beyond = np.array([[-1.1, 2.1], [0.6, 2.1], [-0.9, 3.1], [-0.9, 1.9]])
    np.testing.assert_array_equal(costmap.at(beyond), -1)


def test_goals_in_closed_cells_give_way_to_the_best_open_candidate(module):
    node = module.ExplorerNode()
    node.T_base_camera = np.eye(4)
    views = np.stack([moved(x, 0.25, 0.0) for x in (0.25, 0.75, 1.25)])
    decision = r3jax.Decision(
        views[0], views[:2, :3, 3], 1.0, 3.0, views, {"total": np.array([3.0, 1.0, 2.0])}
    )
    np.testing.assert_array_equal(node.best_open_view(decision), views[0])
    node.on_costmap(costmap_message(module, np.array([[100, 0, 0]], np.int8), 0.5, 0.0, 0.0))
    np.testing.assert_array_equal(node.best_open_view(decision), views[2])
    node.on_costmap(costmap_message(module, np.array([[100, 0, 99]], np.int8), 0.5, 0.0, 0.0))
    np.testing.assert_array_equal(node.best_open_view(decision), views[1])
    node.on_costmap(costmap_message(module, np.full((1, 3), 100, np.int8), 0.5, 0.0, 0.0))
    assert node.best_open_view(decision) is None
    elsewhere = costmap_message(module, np.zeros((1, 3), np.int8), 0.5, 0.0, 0.0)
    elsewhere.header.frame_id = "odom"
    node.on_costmap(elsewhere)
    assert node.said
    assert node.best_open_view(decision) is None


def test_services_start_and_stop(module, monkeypatch):
    node = module.ExplorerNode()
    node.navigator.go(module.PoseStamped(pose=module.pose_of(np.eye(4))))
    node.nav2.sent[0].accept()
    assert node.ask("~/stop").success
    assert node.nav2.sent[0].is_canceled
    assert not node.running
    node.frames.append(module.KeyFrame(0, np.zeros(0), np.zeros(0), np.eye(4)))
    decided = []
    monkeypatch.setattr(node, "decide", lambda: decided.append(1))
    node.callbacks["timer"]()
    assert not decided
    assert node.ask("~/start").success
    node.callbacks["timer"]()
    assert decided
    assert not node.ask("~/save").success  # nothing is mapped yet


def test_the_file_of_parameters_has_all_of_them_with_their_defaults():
    with stubs.ros2():
        settings = importlib.import_module("r3jax_ros.settings").Settings()
    written = yaml.safe_load((stubs.PACKAGE / "config" / "r3jax.yaml").read_text())
    assert written == {"r3jax": {"ros__parameters": vars(settings)}}


def test_without_ros_it_is_said_what_to_do(monkeypatch):
    monkeypatch.syspath_prepend(stubs.PACKAGE)
    main = importlib.import_module("r3jax_ros.main")
    with pytest.raises(SystemExit, match=r"rclpy.*source"):
        main.main()


def test_a_cloud_packs_its_colors_as_rviz_reads_them(module):
    header = module.Header(frame_id="map")
    points = np.array([[1.0, 2.0, 3.0]], np.float32)
    cloud = module.cloud_of(header, points, np.array([[255, 128, 1]], np.uint8))
    np.testing.assert_array_equal(xyz_of(cloud), points)
    assert int.from_bytes(bytes(cloud.data)[12:16], "little") == (255 << 16) | (128 << 8) | 1
    assert cloud.header.frame_id == "map"
