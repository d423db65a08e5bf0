"""r3jax as a ROS 2 node: color, depth, camera_info and tf in; goals, markers and a cloud out.

    python examples/ros2_node.py --ros-args -p bounds:="[-5.0, -4.0, 0.0, 5.0, 4.0, 2.0]" \
        -r color:=/camera/color/image_raw -r camera_info:=/camera/color/camera_info \
        -r depth:=/camera/aligned_depth_to_color/image_raw -r path:=/rtabmap/mapPath

Images are noted as they come and mapped by a timer in a thread of its own, so that tf goes on
meanwhile. `path` (nav_msgs/Path) is the trajectory as a SLAM system has optimized it: when a loop
closure moves it, the key frames move along and are mapped again. See docs/howto/robot.md.
"""

import contextlib
from array import array
from collections import deque
from dataclasses import dataclass, replace

import jax
import message_filters
import numpy as np
import rclpy
import tf2_ros
from geometry_msgs.msg import Point, Pose, PoseStamped
from nav_msgs.msg import Path
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.time import Time
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

import r3jax
from r3jax.apps.audit.live.guide_page import open_guide
from r3jax.formats.depth import resample_depth
from r3jax.formats.points import voxel_points
from r3jax.formats.ros.messages import depth_of, frame_of, lens_of, rgb_of, stamp_of
from r3jax.formats.ros.transforms import TransformTree
from r3jax.planning.growth import GrowthAhead
from r3jax.planning.robot.motion import make_motion

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Reliable, and who subscribes later gets the last one, too."""

MOVED = 0.02
"""A loop closure that moves no key frame by more [m, and entries of the rotation] is ignored."""


@dataclass(frozen=True)
class KeyFrame:
    """What is kept to map it again."""

    stamp: int
    rgb: np.ndarray
    depth: np.ndarray
    T_world_camera: np.ndarray


class NextViewNode(Node):
    """Maps key frames, and says where to go next whenever the robot has arrived."""

    def __init__(self):
        super().__init__("r3jax")
        get = lambda name, default: self.declare_parameter(name, default).value
        self.world, self.base = get("world_frame", "map"), get("base_frame", "base_link")
        self.bounds = np.reshape(get("bounds", [-5.0, -5.0, 0.0, 5.0, 5.0, 2.5]), (2, 3))
        self.policy, self.motion = get("policy", "r3-pano"), get("motion", "ground")
        self.candidates, self.stride = get("candidates", 100), get("stride", 2)
        self.period, self.patience = 1.0 / get("frame_rate", 2.0), get("patience", 60.0)
        self.arrived, self.max_range = get("arrived", 0.3), get("max_range", 5.0)
        self.rows, self.growth = get("map_rows", 1 << 18), GrowthAhead()

        self.pages = contextlib.ExitStack()
        self.pending, self.frames, self.track = deque(maxlen=10), [], None
        self.info, self.planner, self.goal, self.decisions = None, None, None, 0
        self.has_news, self.last_stamp, self.goal_stamp = False, 0, 0

        self.page, port = None, get("page_port", 0)
        if port:  # the page of `r3jax audit --live`, for this robot
            self.page = self.pages.enter_context(open_guide(get("page_host", "127.0.0.1"), port))
            self.get_logger().info(f"where it goes next: {self.page.url}")

        # Two groups: what maps and decides must not keep the images, nor tf, from coming in.
        incoming, self.working = MutuallyExclusiveCallbackGroup(), MutuallyExclusiveCallbackGroup()
        sensor = {"qos_profile": qos_profile_sensor_data, "callback_group": incoming}
        images = [message_filters.Subscriber(self, Image, name, **sensor) for name in
                  ("color", "depth")]  # fmt: skip
        self.pairs = message_filters.ApproximateTimeSynchronizer(images, 10, 0.02)
        self.pairs.registerCallback(self.on_images)
        self.create_subscription(CameraInfo, "camera_info", self.on_info, **sensor)
        self.create_subscription(Path, "path", self.on_path, 1, callback_group=self.working)
        self.tf = tf2_ros.Buffer()
        self.listener = tf2_ros.TransformListener(self.tf, self)
        self.goals = self.create_publisher(PoseStamped, "goal_pose", LATCHED)
        self.markers = self.create_publisher(MarkerArray, "next_view", LATCHED)
        self.clouds = self.create_publisher(PointCloud2, "map_points", LATCHED)
        self.create_timer(0.1, self.work, callback_group=self.working)

    def on_info(self, message) -> None:
        """Notes the camera."""
        self.info = message

    def on_images(self, color, depth) -> None:
        """Notes a pair if it is time for another key frame; it is mapped by `work`."""
        stamp = stamp_of(color)
        if (stamp - self.last_stamp) * 1e-9 >= self.period:
            self.last_stamp = stamp
            self.pending.append((color, depth))

    def work(self) -> None:
        """Maps what has come in, and decides where the robot has arrived. In one thread only."""
        for _ in range(len(self.pending)):
            color, depth = self.pending.popleft()
            frame = self.key_frame(color, depth)
            if frame is None:
                self.pending.append((color, depth))  # its transforms may be still to come
            elif not self.frames or has_moved(self.frames[-1].T_world_camera, frame.T_world_camera):
                self.add(frame)
        if self.has_news and self.is_due():
            self.decide()

    def key_frame(self, color, depth) -> KeyFrame | None:
        """Returns a key frame; None where the camera or its pose is not known."""
        if self.info is None:
            return None
        try:
            T = self.look_up(self.world, frame_of(color), Time.from_msg(color.header.stamp))
            self.T_base_camera = self.look_up(self.base, frame_of(color), Time())
        except tf2_ros.TransformException as error:
            self.get_logger().warning(str(error), throttle_duration_sec=5.0)
            return None
        lens = lens_of(self.info)
        z, every = resample_depth(depth_of(depth), lens), slice(None, None, self.stride)
        rgb, z = rgb_of(color)[every, every].copy(), z[every, every].copy()  # not the whole images
        return KeyFrame(stamp_of(color), rgb, z, T)

    def look_up(self, parent: str, child: str, time) -> np.ndarray:
        """Returns `T_parent_child` [4, 4] of tf."""
        move = self.tf.lookup_transform(parent, child, time).transform
        return matrix_of(move.translation, move.rotation)

    def to_frame(self, key_frame: KeyFrame) -> r3jax.Frame:
        """Returns the frame of every `stride`-th pixel."""
        fx, fy, cx, cy = lens_of(self.info).intrinsics
        height, width = key_frame.depth.shape
        center = [(c - 0.5) / self.stride + 0.5 for c in (cx, cy)]
        camera = r3jax.Camera(width, height, fx / self.stride, fy / self.stride, *center)
        return r3jax.Frame.from_arrays(
            key_frame.rgb, key_frame.depth, key_frame.T_world_camera, camera
        )

    def add(self, key_frame: KeyFrame) -> None:
        """Adds a key frame to the map."""
        frame = self.to_frame(key_frame)
        if self.planner is None:
            self.begin(frame.camera, key_frame.T_world_camera)
        self.frames.append(key_frame)
        self.planner = r3jax.observe(self.planner, frame)
        self.growth.look(self.planner, frame)  # compiles for a larger map before it is one
        self.has_news = True
        if self.page is not None:
            self.page.observed(self.planner, frame)

    def begin(self, camera: r3jax.Camera, T_world_camera: np.ndarray) -> None:
        """Starts an empty map; a robot on wheels keeps its camera's height and tilt."""
        motion = make_motion(self.motion)
        if self.motion == "ground":
            tilt = float(np.degrees(np.arcsin(T_world_camera[2, 2])))
            body = max(0.0, float(self.T_base_camera[2, 3]) - 0.1)
            motion = replace(motion, elevations=(tilt, tilt), body=body)
        few = {"num_candidates": self.candidates, "num_frontier": self.candidates * 3 // 10}
        policy = r3jax.make_policy(self.policy, motion=motion, **few)
        config = r3jax.MappingConfig(max_range=self.max_range, capacity=self.rows)
        starts = [T_world_camera]
        self.planner = r3jax.start(camera, self.bounds, policy, starts=starts, config=config)

    def is_due(self) -> bool:
        """Returns True without a goal, at the goal, and where the robot does not get there."""
        if self.goal is None:
            return True
        here = self.frames[-1]
        away = np.linalg.norm(here.T_world_camera[:3, 3] - self.goal[:3, 3])
        return away < self.arrived or (here.stamp - self.goal_stamp) * 1e-9 > self.patience

    def decide(self) -> None:
        """Publishes the next goal."""
        here, key = self.frames[-1], jax.random.fold_in(jax.random.key(0), self.decisions)
        self.has_news, self.decisions = False, self.decisions + 1
        decision, self.planner, info = r3jax.decide(self.planner, here.T_world_camera, key)
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id=self.world)
        self.clouds.publish(cloud_of(header, *voxel_points(self.planner.map_state)))
        if self.page is not None:
            self.page.decided(self.to_frame(here), decision)
        if decision is None:
            self.get_logger().warning(f"no next view: {info.outcome.value}")
            return
        self.goal, self.goal_stamp = decision.T_world_camera, here.stamp
        T_world_base = self.goal @ np.linalg.inv(self.T_base_camera)
        if self.motion == "ground":
            T_world_base = upright(T_world_base)
        self.goals.publish(PoseStamped(header=header, pose=pose_of(T_world_base)))
        self.markers.publish(markers_of(header, decision))

    def on_path(self, path) -> None:
        """Moves the key frames with the trajectory, and maps them again if they moved."""
        before, self.track = self.track, track_of(path)
        if before is None or not self.frames:
            return
        moved = corrected(self.frames, before, self.track)
        off = [np.abs(a.T_world_camera - b.T_world_camera).max() for a, b in
               zip(moved, self.frames, strict=True)]  # fmt: skip
        if max(off) <= MOVED:
            self.track = before  # small steps add up
            return
        self.get_logger().info(f"loop closed: mapping {len(moved)} key frames again")
        self.frames, self.planner, self.goal, self.has_news = moved, None, None, True
        if self.page is not None:
            self.page.forget()
        for key_frame in moved:
            frame = self.to_frame(key_frame)
            if self.planner is None:
                self.begin(frame.camera, key_frame.T_world_camera)
            self.planner = r3jax.observe(self.planner, frame)
            if self.page is not None:
                self.page.passed(frame)


def has_moved(before: np.ndarray, now: np.ndarray) -> bool:
    """Returns True from 5 cm or 5 degrees on: a robot that stands still adds nothing but memory."""
    turned = np.degrees(Rotation.from_matrix(before[:3, :3].T @ now[:3, :3]).magnitude())
    return bool(np.linalg.norm(now[:3, 3] - before[:3, 3]) > 0.05 or turned > 5.0)


def matrix_of(position, turn) -> np.ndarray:
    """Returns the matrix [4, 4] of a message's position and quaternion."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    T[:3, 3] = position.x, position.y, position.z
    return T


def pose_of(T: np.ndarray) -> Pose:
    """Returns the message of a matrix [4, 4]."""
    pose = Pose()
    pose.position.x, pose.position.y, pose.position.z = T[:3, 3].tolist()
    turn = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = turn
    return pose


def upright(T_world_base: np.ndarray) -> np.ndarray:
    """Returns the pose of a robot that stands on the floor: its x axis ahead, z up."""
    T = np.eye(4)
    yaw = np.arctan2(T_world_base[1, 0], T_world_base[0, 0])
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:2, 3] = T_world_base[:2, 3]
    return T


def track_of(path) -> TransformTree:
    """Returns where the robot was at each stamp of a path."""
    tree = TransformTree()
    for stamped in path.poses:
        T = matrix_of(stamped.pose.position, stamped.pose.orientation)
        turn = Rotation.from_matrix(T[:3, :3]).as_quat()
        tree.add("world", "robot", stamp_of(stamped), T[:3, 3], turn)
    return tree


def corrected(
    frames: list[KeyFrame], before: TransformTree, after: TransformTree
) -> list[KeyFrame]:
    """Returns the key frames moved as the robot's place at their time was.

    The latest as its last place.
    """
    if not before.edges or not after.edges:
        return frames
    times = np.array([frame.stamp for frame in frames], dtype=np.int64)
    known = np.array(before.edges["robot"].times)
    times = times.clip(known.min(), known.max())
    (old, was), (new, now) = (tree.edges["robot"].at(times) for tree in (before, after))
    moves = np.where((was & now)[:, None, None], new @ np.linalg.inv(old), np.eye(4))
    return [replace(frame, T_world_camera=move @ frame.T_world_camera) for frame, move in
            zip(frames, moves, strict=True)]  # fmt: skip


def cloud_of(header: Header, points: np.ndarray, colors: np.ndarray) -> PointCloud2:
    """Returns points [n, 3] with colors [n, 3] uint8, packed into `rgb` as RViz shows them."""
    packed = np.zeros(len(points), [("xyz", "<f4", 3), ("bgr", "u1", 3), ("pad", "u1")])
    packed["xyz"], packed["bgr"] = points, colors[:, ::-1]
    fields = [PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1) for
              i, name in enumerate(("x", "y", "z", "rgb"))]  # fmt: skip
    return PointCloud2(
        header=header, height=1, width=len(points), fields=fields, is_bigendian=False,
        point_step=16, row_step=16 * len(points), data=array("B", packed.tobytes()), is_dense=True,
    )  # fmt: skip


def markers_of(header: Header, decision: r3jax.Decision) -> MarkerArray:
    """Returns the path to the goal, and all candidates: the greener, the better."""
    to_point = lambda xyz: Point(x=float(xyz[0]), y=float(xyz[1]), z=float(xyz[2]))
    line = Marker(header=header, ns="path", type=Marker.LINE_STRIP, action=Marker.ADD)
    line.points = [to_point(xyz) for xyz in decision.waypoints]
    line.scale.x, line.color = 0.03, ColorRGBA(r=0.1, g=0.5, b=1.0, a=1.0)
    dots = Marker(header=header, ns="candidates", type=Marker.SPHERE_LIST, action=Marker.ADD)
    dots.points = [to_point(T[:3, 3]) for T in decision.candidates]
    total = np.nan_to_num(decision.utilities["total"], posinf=0.0, neginf=0.0)
    share = (total - total.min()) / max(float(np.ptp(total)), 1e-9)
    dots.colors = [ColorRGBA(r=1.0 - s, g=s, b=0.2, a=0.8) for s in share.tolist()]
    dots.scale.x = dots.scale.y = dots.scale.z = 0.08
    for marker in (line, dots):
        marker.pose.orientation.w = 1.0
    return MarkerArray(markers=[line, dots])


def main() -> None:
    """Spins: one thread for images and tf, one for the map, one to spare."""
    rclpy.init()
    node, executor = NextViewNode(), MultiThreadedExecutor(num_threads=3)
    executor.add_node(node)
    try:
        executor.spin()
    except KeyboardInterrupt:
        pass
    finally:
        node.pages.close()
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
