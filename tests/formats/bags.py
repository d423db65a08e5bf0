"""The room of the audit's tests, seen by a robot: bags of ROS 1 and ROS 2 as it records them."""

import dataclasses
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from r3jax.formats.lenses import Lens
from tests.formats.phones import LENS, Z_UP_FROM_ROOM, room_poses, smaller, view
from tests.formats.sequences import encoded

COLOR, DEPTH = "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw"
OPTICAL, DEPTH_OPTICAL = "camera_color_optical_frame", "camera_depth_optical_frame"

SERVICE = "/add_two_ints/_service_event"
_SERVICE_TYPE = "int64 a\nint64 b\n---\nint64 sum\n"

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND

T_LINK_OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""REP 103: bodies look along x with z up, optical frames along z with y down."""


def moved(x: float, y: float, z: float, yaw: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", yaw).as_matrix()
    T[:3, 3] = x, y, z
    return T


T_MAP_ODOM, T_BASE_LINK = moved(1.0, 2.0, 0.0, yaw=0.7), moved(0.2, 0.0, 0.5, yaw=0.3)
T_COLOR_DEPTH = moved(-0.06, 0.01, 0.0, yaw=0.0)
"""Of a depth camera beside the color camera."""


@dataclasses.dataclass(frozen=True)
class Robot:
    """What is recorded, and how."""

    color: str = "rgb8"
    """An encoding of sensor_msgs/Image, or jpeg."""

    depth: str = "16UC1"
    """16UC1, 32FC1, or either with compressedDepth or compressedDepth rvl before it."""

    pose: str = "tf"
    """tf; odometry: of base_link, with /tf_static; pose: of the camera, without any tf."""

    registered: bool = True
    """False: depth has a camera and a frame of its own."""

    info: bool = True
    service: bool = False
    """True: and a topic of a recorded service, whose type no parser of messages reads."""

    depth_delay: float = 0.008
    leave_out: tuple[str, ...] = ()
    """Topics."""


@dataclasses.dataclass(frozen=True)
class Sent:
    """A message, with nested dictionaries for nested messages."""

    topic: str
    kind: str
    time: int
    fields: dict[str, Any]


def camera_poses() -> np.ndarray:
    """`T_map_camera` of the images."""
    return np.stack([Z_UP_FROM_ROOM @ pose for pose in room_poses()])


def header(frame: str, time: int) -> dict[str, Any]:
    stamp = {"sec": time // SECOND, "nanosec": time % SECOND}
    return {"stamp": stamp, "frame_id": frame}


def quaternion(T: np.ndarray) -> dict[str, float]:
    return dict(zip("xyzw", Rotation.from_matrix(T[:3, :3]).as_quat().tolist(), strict=True))


def vector(T: np.ndarray) -> dict[str, float]:
    return dict(zip("xyz", T[:3, 3].tolist(), strict=True))


def transform(parent: str, child: str, time: int, T: np.ndarray) -> dict[str, Any]:
    move = {"translation": vector(T), "rotation": quaternion(T)}
    return {"header": header(parent, time), "child_frame_id": child, "transform": move}


def image(pixels: np.ndarray, encoding: str, frame: str, time: int) -> dict[str, Any]:
    """Rows are padded, as some drivers do."""
    rows = np.ascontiguousarray(pixels).reshape(len(pixels), -1).view(np.uint8)
    rows = np.pad(rows, ((0, 0), (0, 5)))
    size = {"height": pixels.shape[0], "width": pixels.shape[1], "step": rows.shape[1]}
    return {"header": header(frame, time), **size, "encoding": encoding, "is_bigendian": 0,
            "data": rows.ravel()}  # fmt: skip


def packed(data: bytes, stored: str, frame: str, time: int) -> dict[str, Any]:
    return {"header": header(frame, time), "format": stored, "data": np.frombuffer(data, np.uint8)}


def camera_info(lens: Lens, frame: str, time: int) -> dict[str, Any]:
    fx, fy, cx, cy = lens.params
    K = np.array([fx, 0.0, cx - 0.5, 0.0, fy, cy - 0.5, 0.0, 0.0, 1.0])
    P = np.array([fx, 0.0, cx - 0.5, 0, 0.0, fy, cy - 0.5, 0, 0.0, 0.0, 1.0, 0])
    none = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
    return {"header": header(frame, time), "height": lens.height, "width": lens.width,
            "distortion_model": "plumb_bob", "d": np.zeros(5), "k": K, "r": np.eye(3).ravel(),
            "p": P, "binning_x": 0, "binning_y": 0, "roi": none}  # fmt: skip


def depth_fields(pose: np.ndarray, robot: Robot, lens: Lens, frame: str, time: int) -> Any:
    """The first pixel has no measurement."""
    meters = view(pose, lens)[1]
    encoding = robot.depth.split()[-1]
    steps = np.rint(1000 * meters).astype("<u2")
    steps[0, 0] = 0
    if not robot.depth.startswith("compressedDepth"):
        floats = meters.astype("<f4")
        floats[0, 0] = np.nan
        return image(floats if encoding == "32FC1" else steps, encoding, frame, time)
    a, b = 10_100.0, 1.0 - 10_100.0 / 10.0  # of the inverse depth: image_transport's defaults
    if encoding == "32FC1":
        steps = np.rint(a / meters + b).astype("<u2")
        steps[0, 0] = 0
    kind = "rvl" if "rvl" in robot.depth else "png"
    data = struct.pack("<iff", 0, a, b) + (rvl(steps) if kind == "rvl" else encoded(steps))
    return packed(data, f"{encoding}; compressedDepth {kind}", frame, time)


def rvl(steps: np.ndarray) -> bytes:
    """RVL as its paper gives it, one nibble after the other, with the size before it."""
    nibbles: list[int] = []

    def put(number: int) -> None:
        while True:
            number, low = number >> 3, number & 7
            nibbles.append(low | (8 if number else 0))
            if not number:
                return

    pixels, at, before = steps.ravel().astype(int).tolist(), 0, 0
    while at < len(pixels):
        end = next((i for i in range(at, len(pixels)) if pixels[i]), len(pixels))
        put(end - at)
        at = end
        end = next((i for i in range(at, len(pixels)) if not pixels[i]), len(pixels))
        put(end - at)
        for value in pixels[at:end]:
            put((value - before) * 2 if value >= before else (before - value) * 2 - 1)
            before = value
        at = end
    nibbles += [0] * (-len(nibbles) % 8)
    words = np.array(nibbles, np.uint32).reshape(-1, 8)
    words = (words << np.arange(28, -1, -4, dtype=np.uint32)).sum(axis=1).astype("<u4")
    return struct.pack("<II", steps.shape[1], steps.shape[0]) + words.tobytes()


def messages(robot: Robot) -> Iterator[Sent]:
    """All that the robot sends, in the order of time but for what /tf_static says at the start."""
    fixed = [("base_link", "camera_link", T_BASE_LINK), ("camera_link", OPTICAL, T_LINK_OPTICAL)]
    fixed.append((OPTICAL, DEPTH_OPTICAL, T_COLOR_DEPTH))
    if robot.pose != "pose":
        moves = [transform(parent, child, START, T) for parent, child, T in fixed]
        yield Sent("/tf_static", "tf2_msgs/msg/TFMessage", START, {"transforms": moves})
    depth_lens = smaller()
    depth_frame = OPTICAL if robot.registered else DEPTH_OPTICAL
    depth_topic = DEPTH if robot.registered else "/camera/depth/image_rect_raw"
    for i, pose in enumerate(camera_poses()):
        time = START + i * SECOND // 2
        yield from _poses(robot, pose, time)
        rgb = view(room_poses()[i], LENS)[0]
        if robot.info:
            for topic, lens, frame in (
                ("/camera/color/camera_info", LENS, OPTICAL),
                (f"{depth_topic.rpartition('/')[0]}/camera_info", depth_lens, depth_frame),
            ):
                fields = camera_info(lens, frame, time)
                yield Sent(topic, "sensor_msgs/msg/CameraInfo", time, fields)
        if robot.color == "jpeg":
            fields = packed(encoded(rgb, "jpeg"), "rgb8; jpeg compressed bgr8", OPTICAL, time)
            yield Sent(f"{COLOR}/compressed", "sensor_msgs/msg/CompressedImage", time + 5, fields)
        else:
            stored = rgb[..., ::-1] if robot.color in ("bgr8", "8UC3") else rgb
            stored = rgb[..., 1] if robot.color == "mono8" else stored
            stored = rgb.astype(np.uint16) * 257 if robot.color == "rgb16" else stored
            fields = image(stored, robot.color, OPTICAL, time)
            yield Sent(COLOR, "sensor_msgs/msg/Image", time + 5, fields)
        seen_from = room_poses()[i] @ (np.eye(4) if robot.registered else T_COLOR_DEPTH)
        late = time + int(robot.depth_delay * SECOND)
        fields = depth_fields(seen_from, robot, depth_lens, depth_frame, late)
        if "format" in fields:
            name = f"{depth_topic}/compressedDepth"
            yield Sent(name, "sensor_msgs/msg/CompressedImage", late + 5, fields)
        else:
            yield Sent(depth_topic, "sensor_msgs/msg/Image", late + 5, fields)


def _poses(robot: Robot, T_map_optical: np.ndarray, time: int) -> Iterator[Sent]:
    """Poses 10 ms before and after an image, halfway between which the robot is where it should."""
    T_odom_map, T_optical_base = (
        np.linalg.inv(T_MAP_ODOM),
        np.linalg.inv(T_BASE_LINK @ T_LINK_OPTICAL),
    )
    for sign in (-1, 1):
        at = time + sign * SECOND // 100
        step = moved(0.0, 0.0, 0.0, yaw=0.05 * sign)
        T_odom_base = T_odom_map @ T_map_optical @ T_optical_base @ step
        T_odom_base[:3, 3] += 0.03 * sign
        moves = [transform("map", "odom", at, T_MAP_ODOM)]
        moves.append(transform("odom", "base_link", at, T_odom_base))
        if robot.pose == "tf":
            yield Sent("/tf", "tf2_msgs/msg/TFMessage", at, {"transforms": moves})
        elif robot.pose == "odometry":
            T = T_MAP_ODOM @ T_odom_base
            pose = {"position": vector(T), "orientation": quaternion(T)}
            zeros = {"linear": dict.fromkeys("xyz", 0.0), "angular": dict.fromkeys("xyz", 0.0)}
            covariance = np.zeros(36)
            yield Sent("/odom", "nav_msgs/msg/Odometry", at, {
                "header": header("map", at), "child_frame_id": "base_link",
                "pose": {"pose": pose, "covariance": covariance},
                "twist": {"twist": zeros, "covariance": covariance},
            })  # fmt: skip
        else:
            T = T_map_optical @ step
            pose = {"position": vector(T), "orientation": quaternion(T)}
            fields = {"header": header("map", at), "pose": pose}
            yield Sent("/slam/pose", "geometry_msgs/msg/PoseStamped", at, fields)


def made(store: Any, kind: str, fields: dict[str, Any]) -> Any:
    """A message of a typestore from nested dictionaries."""
    values = {}
    for name, (_, detail) in store.fielddefs[kind][1]:
        value = fields.get(name, fields.get(name.lower(), 0))  # ROS 1: D, K, R, P and seq
        if isinstance(value, dict):
            value = made(store, detail, value)
        elif isinstance(value, list):
            value = [made(store, detail[0][1], one) for one in value]
        values[name] = value
    return store.types[kind](**values)


def write_bag(path: Path, robot: Robot = Robot(), kind: str = "mcap") -> Path:
    """Writes a bag.

    Args:
        path: the folder (ROS 2) or the file (ROS 1).
        robot: what is in it.
        kind: mcap, db3 or bag.
    """
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    is_1 = kind == "bag"
    store = get_typestore(Stores.ROS1_NOETIC if is_1 else Stores.ROS2_HUMBLE)
    tf = "tf2_msgs/msg/TFMessage"
    if tf not in store.types:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", tf))
    if is_1:
        writer: Any = rosbag1.Writer(path)
    else:
        plugin = rosbag2.StoragePlugin.MCAP if kind == "mcap" else rosbag2.StoragePlugin.SQLITE3
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
    serialize = store.serialize_ros1 if is_1 else store.serialize_cdr
    connections: dict[str, Any] = {}
    with writer:
        if robot.service:
            digest = {"md5sum": "0" * 32} if is_1 else {"rihs01": "RIHS01_" + "0" * 64}
            event = writer.add_connection(
                SERVICE,
                "interfaces/msg/Event" if is_1 else "interfaces/srv/AddTwoInts_Event",
                msgdef=_SERVICE_TYPE,
                **digest,
            )
            writer.write(event, START, b"\0\1\0\0" + bytes(40))
        for sent in messages(robot):
            if sent.topic in robot.leave_out:
                continue
            if sent.topic not in connections:
                connections[sent.topic] = writer.add_connection(
                    sent.topic, sent.kind, typestore=store
                )
            message = made(store, sent.kind, sent.fields)
            writer.write(connections[sent.topic], sent.time, serialize(message, sent.kind))
    return path
