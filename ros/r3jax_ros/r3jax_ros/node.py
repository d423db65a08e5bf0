"""The node: color, depth, camera_info, tf and a costmap in; goals of Nav2, markers and a cloud out.

Images are noted as they come and mapped by a timer in a thread of its own, so that tf goes on
meanwhile. `path` (nav_msgs/Path) is the trajectory as a SLAM system has optimized it: when a loop
closure moves it, the key frames move along and are mapped again in another thread, while the robot
waits. See docs/howto/robot.md.
"""

import contextlib
import signal
import time
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from threading import Event

import jax
import message_filters
import numpy as np
import rclpy
import tf2_ros
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid, Path
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

import r3jax
from r3jax.formats.depth import resample_depth
from r3jax.formats.points import voxel_points
from r3jax.formats.ros.messages import depth_of, frame_of, lens_of, rgb_of, stamp_of
from r3jax.planning.growth import GrowthAhead
from r3jax.planning.robot.motion import make_motion
from r3jax_ros.messages import Costmap, cloud_of, markers_of, matrix_of, pose_of
from r3jax_ros.navigation import Navigator
from r3jax_ros.settings import declared
from r3jax_ros.trajectory import (
    KeyFrame,
    base_for_view,
    corrected,
    has_arrived,
    has_moved,
    track_of,
    with_later,
)

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Reliable, and a late subscriber gets the last message, too."""

MOVED = 0.02
"""A loop closure that moves no key frame by more [m, and entries of the rotation] is ignored."""


class ExplorerNode(Node):
    """Maps key frames, and sends the robot to the next view whenever it has arrived."""

    def __init__(self):
        super().__init__("r3jax")
        self.settings = settings = declared(self)
        self.bounds = np.reshape(settings.bounds, (2, 3))
        self.running, self.growth = settings.autostart, GrowthAhead()
        self.costmap, self.drawn = None, None  # the latest, and the one that the planner has
        self.pages, self.mapper = contextlib.ExitStack(), ThreadPoolExecutor(1)
        self.pending, self.frames, self.track = deque(maxlen=10), [], None
        self.info, self.planner, self.goal, self.decisions = None, None, None, 0
        self.has_news, self.last_stamp, self.goal_time, self.chosen = False, 0, 0, None
        self.rebuilding: tuple[Future, int] | None = None

        self.page = None
        if settings.page_port:  # the page of `r3jax audit --live`, for this robot
            from r3jax.apps.audit.live.guide_page import open_guide  # it needs plots: seconds

            guide = open_guide(settings.page_host, settings.page_port)
            self.page = self.pages.enter_context(guide)
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
        self.create_subscription(
            OccupancyGrid, "costmap", self.on_costmap, LATCHED, callback_group=self.working
        )
        self.tf = tf2_ros.Buffer()
        self.listener = tf2_ros.TransformListener(self.tf, self)
        self.navigator = Navigator(self, settings.navigate_action, self.working)
        self.goals = self.create_publisher(PoseStamped, "next_goal", LATCHED)
        self.markers = self.create_publisher(MarkerArray, "next_view", LATCHED)
        self.clouds = self.create_publisher(PointCloud2, "map_points", LATCHED)
        # A robot that is to stop does not wait for a decision.
        groups = {"start": incoming, "stop": incoming, "save": self.working, "load": self.working}
        for name, group in groups.items():
            answer = getattr(self, f"on_{name}")
            self.create_service(Trigger, f"~/{name}", answer, callback_group=group)
        self.create_timer(0.1, self.work, callback_group=self.working)

    # ------------------------------------------------------------------------------- messages

    def on_info(self, message) -> None:
        """Notes the camera."""
        self.info = message

    def on_costmap(self, message) -> None:
        """Notes where Nav2 says that the robot cannot stand."""
        if message.header.frame_id != self.settings.world_frame:
            self.get_logger().warning(
                f"the costmap is in {message.header.frame_id!r}, not in world_frame "
                f"{self.settings.world_frame!r}: ignored",
                throttle_duration_sec=10.0,
            )
            return
        self.costmap = Costmap(message)

    def on_images(self, color, depth) -> None:
        """Notes a pair if it is time for another key frame; it is mapped by `work`."""
        stamp = stamp_of(color)
        if (stamp - self.last_stamp) * 1e-9 * self.settings.frame_rate >= 1.0:
            self.last_stamp = stamp
            self.pending.append((color, depth))

    def on_path(self, path) -> None:
        """Moves the key frames with the trajectory, and maps them again if they moved."""
        if len(path.poses) > 1 and len({stamp_of(pose) for pose in path.poses}) == 1:
            self.get_logger().warning(
                "all poses of the path have one stamp, so that loop closures cannot be followed: "
                "each pose needs the stamp of its own time",
                throttle_duration_sec=60.0,
            )
            return
        if self.rebuilding is not None:
            return  # the next path tells of what this one does
        before, self.track = self.track, track_of(path)
        if before is None or not self.frames:
            return
        moved = corrected(self.frames, before, self.track)
        off = [np.abs(a.T_world_camera - b.T_world_camera).max() for a, b in
               zip(moved, self.frames, strict=True)]  # fmt: skip
        if max(off) <= MOVED:
            self.track = with_later(before, self.track)  # small steps add up
            return
        self.get_logger().info(f"loop closed: mapping {len(moved)} key frames again")
        self.navigator.cancel()
        self.frames, self.goal = moved, None
        if self.page is not None:
            self.page.forget()
        task = self.mapper.submit(r3jax.rebuild, self.planner, map(self.to_frame, moved))
        self.rebuilding = task, len(moved)

    # ------------------------------------------------------------------------------- services

    def on_start(self, request, response):
        """Begins to explore, or goes on."""
        self.running, self.has_news = True, bool(self.frames)
        response.success, response.message = True, "exploring"
        return response

    def on_stop(self, request, response):
        """Stops the robot; images are mapped all the while."""
        self.stop()
        response.success, response.message = True, "stopped; images are still mapped"
        return response

    def stop(self) -> None:
        """Cancels the goal, and sends no further one."""
        with self.navigator.lock:
            self.running, self.goal = False, None
            self.navigator.cancel()

    def on_save(self, request, response):
        """Writes the planner to `map_file`."""
        if self.planner is None:
            response.success, response.message = False, "nothing is mapped yet"
            return response
        return self._tried(response, "saved", lambda: r3jax.save(self.planner, self.map_file))

    def on_load(self, request, response):
        """Takes the planner of `map_file` in place of the present one."""

        def load() -> None:
            self.planner, self.rebuilding = r3jax.load(self.map_file), None
            # Its key frames are not in the file: a closure moves what comes from now on.
            self.frames, self.goal, self.track, self.has_news = [], None, None, False
            self.chosen, self.drawn = None, None
            self.navigator.cancel()

        return self._tried(response, "loaded", load)

    @property
    def map_file(self) -> str:
        """Where the planner is kept."""
        return self.settings.map_file

    def _tried(self, response, done: str, task):
        try:
            task()
            response.success, response.message = True, f"{done} {self.map_file}"
        except Exception as error:  # a service answers, whatever went wrong
            response.success, response.message = False, f"{type(error).__name__}: {error}"
            self.get_logger().warning(response.message)
        return response

    # ------------------------------------------------------------------------------- the work

    def work(self) -> None:
        """Maps what has come in, and decides where the robot has arrived. In one thread only."""
        early = []
        for _ in range(len(self.pending)):
            color, depth = self.pending.popleft()
            frame = self.key_frame(color, depth)
            if frame is None:
                early.append((color, depth))  # its transforms may be still to come
                continue
            early.clear()  # transforms come in the order of time: tf has forgotten those before
            if not self.frames or has_moved(self.frames[-1].T_world_camera, frame.T_world_camera):
                self.add(frame)
        self.pending.extendleft(reversed(early))
        if self.rebuilding is not None and self.rebuilding[0].done():
            self.swap()
        if self.running and self.rebuilding is None and self.frames and self.is_due():
            self.decide()

    def key_frame(self, color, depth) -> KeyFrame | None:
        """A key frame; None where the camera or its pose is not known."""
        if self.info is None:
            return None
        settings = self.settings
        try:
            stamp = Time.from_msg(color.header.stamp)
            T = self.look_up(settings.world_frame, frame_of(color), stamp)
            self.T_base_camera = self.look_up(settings.base_frame, frame_of(color), Time())
        except tf2_ros.TransformException as error:
            self.get_logger().warning(str(error), throttle_duration_sec=5.0)
            return None
        lens, every = lens_of(self.info), slice(None, None, settings.stride)
        z = resample_depth(depth_of(depth), lens)
        rgb, z = rgb_of(color)[every, every].copy(), z[every, every].copy()  # not the whole images
        return KeyFrame(stamp_of(color), rgb, z, T)

    def look_up(self, parent: str, child: str, time) -> np.ndarray:
        """`T_parent_child` [4, 4] of tf, composed along its chain: map, odom, base, camera."""
        move = self.tf.lookup_transform(parent, child, time).transform
        return matrix_of(move.translation, move.rotation)

    def to_frame(self, key_frame: KeyFrame) -> r3jax.Frame:
        """The frame of every `stride`-th pixel."""
        stride, (fx, fy, cx, cy) = self.settings.stride, lens_of(self.info).intrinsics
        height, width = key_frame.depth.shape
        center = [(c - 0.5) / stride + 0.5 for c in (cx, cy)]
        camera = r3jax.Camera(width, height, fx / stride, fy / stride, *center)
        return r3jax.Frame.from_arrays(
            key_frame.rgb, key_frame.depth, key_frame.T_world_camera, camera
        )

    def add(self, key_frame: KeyFrame) -> None:
        """Adds a key frame to the map; to a map that is being rebuilt, when it is ready."""
        self.frames.append(key_frame)
        if self.rebuilding is None:
            self.observe(key_frame)

    def observe(self, key_frame: KeyFrame) -> None:
        """Maps a key frame."""
        frame = self.to_frame(key_frame)
        if self.planner is None:
            self.begin(frame.camera, key_frame.T_world_camera)
        self.planner = jax.block_until_ready(r3jax.observe(self.planner, frame))
        late = (self.get_clock().now().nanoseconds - key_frame.stamp) * 1e-6
        self.get_logger().debug(f"mapped {late:.0f} ms after its image was taken")
        self.growth.look(self.planner, frame)  # compiles for a larger map before it is one
        self.has_news = True
        if self.page is not None:
            self.page.observed(self.planner, frame)

    def swap(self) -> None:
        """Takes the rebuilt planner, and maps what has come in meanwhile."""
        (task, num), self.rebuilding = self.rebuilding, None
        self.planner, self.has_news, self.drawn = task.result(), True, None
        if self.page is not None:
            for key_frame in self.frames[:num]:
                self.page.passed(self.to_frame(key_frame))
        for key_frame in self.frames[num:]:
            self.observe(key_frame)

    def begin(self, camera: r3jax.Camera, T_world_camera: np.ndarray) -> None:
        """Starts an empty map; a robot on wheels keeps its camera's height and tilt."""
        settings, motion = self.settings, make_motion(self.settings.motion)
        if settings.motion == "ground":
            tilt = float(np.degrees(np.arcsin(np.clip(T_world_camera[2, 2], -1.0, 1.0))))
            motion = replace(motion, elevations=(tilt, tilt), body=self.body())
        few = {"num_candidates": settings.candidates,
               "num_frontier": settings.candidates * 3 // 10}  # fmt: skip
        policy = r3jax.make_policy(settings.policy, motion=motion, **few)
        config = r3jax.MappingConfig(
            max_range=settings.max_range,
            capacity=settings.map_rows,
            remove_moved=settings.remove_moved,
        )
        starts = [T_world_camera]
        self.planner = r3jax.start(camera, self.bounds, policy, starts=starts, config=config)

    def body(self) -> r3jax.Body:
        """Describes the robot round its camera, which r3jax plans for."""
        settings, at = self.settings, self.T_base_camera[:2, 3]
        if len(settings.footprint) == 1:
            # The disk round the camera that holds the disk round the base.
            footprint = settings.footprint[0] + float(np.hypot(*at))
        else:
            yaw = np.arctan2(*self.T_base_camera[1::-1, 2])
            turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
            corners = (np.reshape(settings.footprint, (-1, 2)) - at) @ turn
            footprint = tuple((float(x), float(y)) for x, y in corners)
        heights = (0.0, settings.height or None)
        floor = float(self.bounds[0, 2])
        return r3jax.Body(footprint, heights, margin=settings.margin, floor=floor)

    def is_due(self) -> bool:
        """True at the goal or without one, and, even if nothing is new, where the goal failed."""
        spent = (self.get_clock().now().nanoseconds - self.goal_time) * 1e-9
        if self.navigator.is_busy and spent > self.settings.patience:
            self.navigator.give_up(f"not reached in {self.settings.patience:g} s")
        if not (self.has_news or self.navigator.state == "failed"):
            return False
        if not self.navigator.is_ready():
            return False
        if self.goal is None or not self.navigator.is_busy:
            return True
        return has_arrived(self.frames[-1].T_world_camera, self.goal, self.settings.arrived)

    def decide(self) -> None:
        """Sends the robot to the next view."""
        here, key = self.frames[-1], jax.random.fold_in(jax.random.key(0), self.decisions)
        self.has_news, self.decisions = False, self.decisions + 1
        if self.chosen is not None and self.navigator.state == "failed":
            self.planner = r3jax.refuse(self.planner, self.chosen)
        if self.costmap is not self.drawn and self.costmap.is_aligned:
            layer = self.costmap.cost, self.costmap.resolution, self.costmap.origin
            trusts = self.settings.trust_costmap
            self.planner = r3jax.with_costmap(self.planner, *layer, trust_free=trusts)
            self.drawn = self.costmap
        decision, self.planner, info = r3jax.decide(self.planner, here.T_world_camera, key)
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id=self.settings.world_frame)
        self.clouds.publish(cloud_of(header, *voxel_points(self.planner.map_state)))
        if self.page is not None:
            self.page.decided(self.to_frame(here), decision)
        view = None if decision is None else self.best_open_view(decision)
        if decision is None or view is None:
            self.navigator.cancel()
            self.goal = None
            closed = "the costmap closes every candidate"
            why = closed if decision else f"{info.outcome.value}: {info.reason}"
            self.get_logger().warning(f"no next view: {why}")
            return
        self.chosen = replace(decision, T_world_camera=view)
        pose = PoseStamped(header=header, pose=pose_of(self.base_of(view)))
        with self.navigator.lock:
            if self.running:
                self.goal, self.goal_time = view, self.get_clock().now().nanoseconds
                self.goals.publish(pose)
                self.markers.publish(markers_of(header, decision))
                self.navigator.go(pose)

    def base_of(self, T_world_camera: np.ndarray) -> np.ndarray:
        """Where the base stands when the camera has a view."""
        if self.settings.motion == "ground":
            return base_for_view(T_world_camera, self.T_base_camera)
        return T_world_camera @ np.linalg.inv(self.T_base_camera)

    def best_open_view(self, decision: r3jax.Decision) -> np.ndarray | None:
        """The decision's view, or the best candidate whose place the costmap leaves open."""
        if self.costmap is None:
            return decision.T_world_camera
        order = np.argsort(-np.nan_to_num(decision.utilities["total"], nan=-np.inf))
        views = [decision.T_world_camera, *decision.candidates[order]]
        places = np.stack([self.base_of(T)[:3, 3] for T in views])
        is_open = self.costmap.at(places) < self.settings.occupied_cost
        return views[int(np.argmax(is_open))] if is_open.any() else None


def spin() -> None:
    """Spins: one thread for images and tf, one for the map, one to spare.

    rclpy's own handlers would close the connection first, and the robot would drive on.
    """
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    interrupted, signals = Event(), (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(one, lambda *_: interrupted.set()) for one in signals]
    node, executor = ExplorerNode(), MultiThreadedExecutor(num_threads=3)
    executor.add_node(node)
    try:
        while not interrupted.is_set():
            executor.spin_once()
    finally:
        for one, handler in zip(signals, before, strict=True):
            signal.signal(one, handler)  # a second Ctrl-C ends it at once
        node.stop()
        end = time.monotonic() + 2.0
        while not node.navigator.is_settled and time.monotonic() < end:
            executor.spin_once(timeout_sec=0.1)
        executor.shutdown()
        node.mapper.shutdown(wait=False, cancel_futures=True)
        node.pages.close()
        node.destroy_node()
        rclpy.try_shutdown()
