"""A robot with a real ROS 2: a camera in an embedded scene, tf, a costmap, and Nav2's action.

    python -m tests.ros.robot --goals 30 --width 640    # how long the node takes, on a real ROS 2

The node runs in a process of its own; what it gets and sends goes over the network.
"""

import argparse
import importlib.util
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped, TransformStamped
from nav2_msgs.action import NavigateToPose
from nav_msgs.msg import OccupancyGrid
from nav_msgs.msg import Path as PathMessage
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

import r3jax
from tests.formats.bags import moved
from tests.rooms_of_boxes import pose_at

ROOT = Path(__file__).resolve().parents[2]
PACKAGE, STANDINS = ROOT / "ros" / "r3jax_ros", Path(__file__).parent / "standins"
OPTICAL = "camera_color_optical_frame"
T_BASE_CAMERA = pose_at((0.1, 0.0, 0.5), 0.0, -10.0)
START = moved(3.9, 2.2, 0.0)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
OUT = {"next_goal": PoseStamped, "next_view": MarkerArray, "map_points": PointCloud2}


def missing() -> list[str]:
    """Modules of ROS that have a stand-in here and are not installed."""
    return [name for name in ("message_filters", "tf2_ros") if not importlib.util.find_spec(name)]


def wait_for(what: Callable[[], Any], seconds: float, why: str) -> Any:
    """The first value that is not empty.

    Raises:
        AssertionError: none within the time.
    """
    end = time.monotonic() + seconds
    while not (found := what()):
        assert time.monotonic() < end, f"not within {seconds:g} s: {why}"
        time.sleep(0.01)
    return found


class Robot(Node):
    """Stands for camera driver, localization and Nav2: it drives to each goal."""

    def __init__(self, width: int, rate: float):
        super().__init__("robot")
        camera = r3jax.Camera.from_fov(width, width * 3 // 4, 69.0)
        self.T_map_base, self.camera = START, camera
        self.world = r3jax.open_scene("flat", camera=camera, start_pose=START @ T_BASE_CAMERA)
        self.images, self.shown, self.moves = 0, None, threading.Condition()
        self.goals: list[np.ndarray] = []
        self.results: list[int] = []
        self.received: dict[str, list[Any]] = {name: [] for name in OUT}
        self.waits: list[float] = []
        self.done_at: float | None = None
        self.is_refusing, self.is_blocked, self.drives = False, False, 0
        self.T_base_camera = T_BASE_CAMERA
        sensor = qos_profile_sensor_data
        self.color = self.create_publisher(Image, "color", sensor)
        self.depth = self.create_publisher(Image, "depth", sensor)
        self.info = self.create_publisher(CameraInfo, "camera_info", sensor)
        self.tf = self.create_publisher(TFMessage, "/tf", 100)
        self.tf_static = self.create_publisher(TFMessage, "/tf_static", LATCHED)
        self.costmap = self.create_publisher(OccupancyGrid, "costmap", LATCHED)
        self.path = self.create_publisher(PathMessage, "path", 1)
        self.tf_static.publish(TFMessage(transforms=[transform("base_link", OPTICAL,
                                                               T_BASE_CAMERA)]))  # fmt: skip
        for name, kind in OUT.items():
            self.create_subscription(kind, name, self.received[name].append, LATCHED)
        self.ask = {name: self.create_client(Trigger, f"/r3jax/{name}") for name in
                         ("start", "stop", "save", "load")}  # fmt: skip
        group = ReentrantCallbackGroup()
        self.server = ActionServer(
            self, NavigateToPose, "navigate_to_pose", self.drive, callback_group=group,
            goal_callback=self.take, cancel_callback=lambda _: CancelResponse.ACCEPT,
        )  # fmt: skip
        alone = MutuallyExclusiveCallbackGroup()
        self.create_timer(1.0 / rate, self.look, callback_group=alone)

    def look(self) -> None:
        """Publishes where the robot is, and what it sees."""
        T = self.T_map_base
        if self.shown is None or not np.array_equal(self.shown[0], T):
            frame = self.world.render((T @ T_BASE_CAMERA).astype(np.float32))
            rgb = np.rint(np.clip(np.asarray(frame.rgb), 0.0, 1.0) * 255.0).astype(np.uint8)
            z = np.asarray(frame.depth)
            self.shown = T, rgb, np.where(np.isfinite(z), z, 0.0).astype(np.float32)
        _, rgb, depth = self.shown
        stamp = self.get_clock().now().to_msg()
        steps = transform("map", "odom", np.eye(4)), transform("odom", "base_link", T)
        for step in steps:
            step.header.stamp = stamp
        self.tf.publish(TFMessage(transforms=list(steps)))
        self.info.publish(self.stamped(camera_info(self.camera), stamp))
        self.color.publish(self.stamped(image(rgb, "rgb8"), stamp))
        self.depth.publish(self.stamped(image(depth, "32FC1"), stamp))
        with self.moves:
            self.images += 1
            self.moves.notify_all()

    def stamped(self, message: Any, stamp: Any) -> Any:
        """The message with its header."""
        message.header.stamp, message.header.frame_id = stamp, OPTICAL
        return message

    def take(self, goal: NavigateToPose.Goal) -> GoalResponse:
        """Answers a goal."""
        if self.done_at is not None:
            self.waits.append(time.monotonic() - self.done_at)
            self.done_at = None
        assert goal.pose.header.frame_id == "map"
        self.goals.append(matrix(goal.pose.pose))
        return GoalResponse.REJECT if self.is_refusing else GoalResponse.ACCEPT

    def drive(self, handle: Any) -> NavigateToPose.Result:
        """Drives to a goal unless it is canceled."""
        self.drives += 1
        self.results.append(self.end_of(handle))
        self.drives -= 1
        return NavigateToPose.Result()

    def end_of(self, handle: Any) -> int:
        """Drives along the path that the node published; the status at the end."""
        goal = matrix(handle.request.pose.pose)
        for T in self.way_to(goal):
            while self.is_blocked and not handle.is_cancel_requested:
                self.next_image()
            if handle.is_cancel_requested:
                handle.canceled()
                return GoalStatus.STATUS_CANCELED
            self.T_map_base = T
            left = float(np.linalg.norm((goal - T)[:2, 3]))
            handle.publish_feedback(NavigateToPose.Feedback(distance_remaining=left))
            self.next_image()
        self.done_at = time.monotonic()
        handle.succeed()
        return GoalStatus.STATUS_SUCCEEDED

    def next_image(self) -> None:
        """Waits for an image that was rendered after now."""
        with self.moves:
            number = self.images
            self.moves.wait_for(lambda: self.images > number + 1, 5.0)

    def way_to(self, goal: np.ndarray) -> Iterator[np.ndarray]:
        """Poses of the base on the way: it looks ahead, and turns at the end."""
        wanted = (goal @ T_BASE_CAMERA)[:2, 3]
        ends = lambda: [m for m in self.received["next_view"] if np.allclose(
            line(m)[-1, :2], wanted, atol=1e-3)]  # fmt: skip
        points = line(wait_for(ends, 5.0, "next_view with the path to the goal")[-1])
        for a, b in zip(points[:-1, :2], points[1:, :2], strict=True):
            length = float(np.linalg.norm(b - a))
            yaw = float(np.arctan2(*(b - a)[::-1]))
            for share in np.arange(0.0, length, 0.5) / max(length, 1e-9):
                ahead = moved(*(a + share * (b - a)), 0.0, yaw=yaw)
                yield ahead @ moved(-T_BASE_CAMERA[0, 3], 0.0, 0.0)
        yield goal


def line(message: MarkerArray) -> np.ndarray:
    """The path of a message, [n, 3] [m]."""
    return np.array([[p.x, p.y, p.z] for p in message.markers[0].points])


def matrix(pose: Any) -> np.ndarray:
    """The matrix [4, 4] of a planar pose."""
    yaw = 2.0 * np.arctan2(pose.orientation.z, pose.orientation.w)
    return moved(pose.position.x, pose.position.y, pose.position.z, yaw=yaw)


def transform(parent: str, child: str, T: np.ndarray) -> TransformStamped:
    """The message of a pose."""
    found = TransformStamped(child_frame_id=child)
    found.header.frame_id = parent
    move, turn = found.transform.translation, found.transform.rotation
    move.x, move.y, move.z = T[:3, 3].tolist()
    turn.x, turn.y, turn.z, turn.w = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    return found


def image(pixels: np.ndarray, encoding: str) -> Image:
    """The message of an image."""
    height, width = pixels.shape[:2]
    found = Image(height=height, width=width, encoding=encoding, step=pixels.nbytes // height)
    found.data.frombytes(pixels.tobytes())
    return found


def camera_info(camera: r3jax.Camera) -> CameraInfo:
    """The message of a camera, whose pixel centers lie at whole numbers."""
    k = [camera.fx, 0.0, camera.cx - 0.5, 0.0, camera.fy, camera.cy - 0.5, 0.0, 0.0, 1.0]
    return CameraInfo(height=camera.height, width=camera.width, distortion_model="plumb_bob",
                      d=[0.0] * 5, k=[float(x) for x in k])  # fmt: skip


class Explorer:
    """The process of the node, and what it says."""

    def __init__(self, folder: Path, *arguments: str, **parameters: Any):
        paths = [str(PACKAGE), str(ROOT), *([str(STANDINS)] if missing() else []), *sys.path]
        given = [text for name, value in parameters.items() for text in
                 ("-p", f"{name}:={value}")]  # fmt: skip
        settings = str(PACKAGE / "config" / "r3jax.yaml")
        command = [sys.executable, "-m", "r3jax_ros.main", "--ros-args", "--params-file", settings]
        self.file = folder / "node.log"
        with self.file.open("w") as output:
            self.process = subprocess.Popen(
                [*command, *given, *arguments], cwd=folder, stdout=output, stderr=output,
                env=os.environ | {"PYTHONPATH": os.pathsep.join(paths), "PYTHONUNBUFFERED": "1",
                                  "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"},
            )  # fmt: skip

    @property
    def said(self) -> str:
        """All that it has printed."""
        return self.file.read_text()

    def stop(self, how: int = signal.SIGINT) -> int:
        """Interrupts it; its exit status."""
        self.process.send_signal(how)
        return self.process.wait(30.0)


@contextmanager
def running(width: int, rate: float) -> Iterator[Robot]:
    """A robot whose callbacks are called."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
    rclpy.init(args=[])
    robot, executor = Robot(width, rate), MultiThreadedExecutor(num_threads=4)
    executor.add_node(robot)
    thread = threading.Thread(target=executor.spin)
    thread.start()
    try:
        yield robot
    finally:
        robot.is_blocked = False
        executor.shutdown()
        rclpy.try_shutdown()
        thread.join()


def parameters_of(robot: Robot) -> dict[str, Any]:
    """Parameters for the flat."""
    bounds = np.array(robot.world.bounds, np.float64)
    bounds[0, 2] = 0.0
    return {"bounds": [float(x) for x in bounds.ravel()], "frame_rate": 5.0, "max_range": 5.0}


def main() -> None:
    """Measures a mission."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--goals", type=int, default=30)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--rate", type=float, default=5.0)
    parser.add_argument("--out", type=Path, default=Path())
    options = parser.parse_args()
    with running(options.width, options.rate) as robot:
        explorer = Explorer(options.out, "--log-level", "r3jax:=debug", **parameters_of(robot))
        try:
            wait_for(lambda: len(robot.results) >= options.goals or
                     explorer.process.poll() is not None, 550.0, "all goals")  # fmt: skip
        finally:
            print("exit", explorer.stop())
        mapped = [float(x) for x in re.findall(r"mapped ([0-9]+) ms", explorer.said)]
        for name, times in (("publication to map", mapped),
                            ("arrival to goal", [1e3 * s for s in robot.waits])):  # fmt: skip
            print(name, len(times), np.percentile(times, [50, 95]).round(), "ms")
        print({one: robot.results.count(one) for one in robot.results}, len(robot.goals), "goals")


if __name__ == "__main__":
    main()
