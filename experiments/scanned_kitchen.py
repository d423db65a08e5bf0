"""A kitchen as somebody would scan it: a recording and a ROS bag of the same 250 pictures.

    python -m experiments.scanned_kitchen runs/scans

Held by hand through the rendered kitchen: noise in colors, depth and poses, no depth beyond 4 m and
on edges. And what goes wrong in a scan: twelve pictures blurred by motion, the exposure 16 % up
from picture 120 on, one pose 8 cm off. The bag (MCAP) has JPEG and compressedDepth, and its poses
as map -> odom -> base_link -> camera. Needs `r3jax[ros]`; takes some minutes.
"""

import io
import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d, maximum_filter, minimum_filter, uniform_filter1d
from scipy.spatial.transform import Rotation

from r3jax.geometry.cameras import Camera, look_at
from r3jax.simulators.raycast.raycast import RaycastSimulator
from r3jax.simulators.scenes.registry import open_world

CAMERA = Camera.from_fov(640, 480, 69.0)
FRAMES = 250
PLACES = [(1.0, 1.2), (2.8, 1.1), (4.6, 1.4), (5.0, 2.6), (3.4, 3.0), (1.4, 3.0), (0.9, 2.0)]
"""Walked round twice [m]: first looking at the walls, then into the room."""

BLURRED = (31, 32, 33, 77, 78, 101, 150, 151, 152, 153, 200, 201)
BRIGHTER_FROM, BRIGHTER = 120, 1.16
MISPLACED, OFFSET = 180, np.array([0.08, 0.0, 0.0])

SECOND = 1_000_000_000
START, PERIOD = 1_700_000_000 * SECOND, SECOND // 5
T_BASE_CAMERA = np.array([[0.0, 0, 1, 0.1], [-1, 0, 0, 0], [0, -1, 0, 0.4], [0, 0, 0, 1]])


def poses() -> np.ndarray:
    """`T_world_camera` of the walk, [n, 4, 4]: smooth, with the tremor of a hand."""
    random = np.random.default_rng(0)
    ring = np.array([*PLACES, PLACES[0]], float)
    spline = CubicSpline(np.linspace(0.0, 1.0, len(ring)), ring, bc_type="periodic")
    middle = np.mean(ring[:-1], axis=0)
    tremor: np.ndarray = gaussian_filter1d(random.normal(size=(FRAMES, 6)), 2.0, axis=0)
    tremor *= [0.02, 0.02, 0.02, 0.03, 0.03, 0.03]
    found = []
    for i, shake in enumerate(tremor):
        lap, part = divmod(2.0 * i / FRAMES, 1.0)
        eye = np.array([*spline(part), 1.45 + 0.1 * np.sin(9.0 * part)]) + shake[:3]
        away = (eye[:2] - middle) * (1.0 if lap == 0.0 else -1.0)
        yaw = np.arctan2(away[1], away[0]) + 0.6 * np.sin(14.0 * part)
        pitch = -0.25 + 0.3 * np.sin(23.0 * part)
        ahead = [np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)]
        pose = np.asarray(look_at(eye, eye + np.array(ahead)), np.float64)
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(shake[3:]).as_matrix()
        u, _, vt = np.linalg.svd(pose[:3, :3])
        pose[:3, :3] = u @ vt
        found.append(pose)
    return np.stack(found)


def sensed(rgb: np.ndarray, depth: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
    """What a phone or a robot's camera makes of an image: [H, W, 3] uint8, [H, W] uint16 [mm]."""
    random = np.random.default_rng(1000 + number)
    if number in BLURRED:
        rgb = uniform_filter1d(rgb, 15, axis=1)
    rgb = rgb * (BRIGHTER if number >= BRIGHTER_FROM else 1.0)
    rgb = rgb + random.normal(0.0, 2.0 / 255.0, rgb.shape)
    z = np.where(np.isfinite(depth), depth, 0.0)
    near, far = minimum_filter(z, 3), maximum_filter(z, 3)
    is_lost = (far - near > 0.04 * z + 0.01) | (z > 4.0) | (random.random(z.shape) < 0.01)
    z = z * (1.0 + random.normal(0.0, 0.008, z.shape))
    steps = np.where(is_lost, 0.0, 1000.0 * z)
    return np.rint(255 * rgb.clip(0, 1)).astype(np.uint8), np.rint(steps).astype(np.uint16)


def estimated(true: np.ndarray) -> np.ndarray:
    """Poses as SLAM would give them: 3 mm and a tenth of a degree off, one of them by far."""
    random, found = np.random.default_rng(7), true.copy()
    found[:, :3, 3] += random.normal(0.0, 0.003, (len(true), 3))
    turns = Rotation.from_rotvec(random.normal(0.0, np.radians(0.1), (len(true), 3)))
    found[:, :3, :3] = turns.as_matrix() @ found[:, :3, :3]
    found[MISPLACED, :3, 3] += OFFSET
    return found


def encoded(pixels: np.ndarray, kind: str) -> bytes:
    """A file of the pixels."""
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, kind, **({"quality": 92} if kind == "jpeg" else {}))
    return file.getvalue()


def write(folder: Path) -> None:
    """Renders once, and writes both."""
    simulator = RaycastSimulator(open_world("kitchen"), CAMERA, max_range=None)
    true = poses()
    given = estimated(true)
    recording, bag = folder / "kitchen", Bag(folder / "kitchen_bag")
    for name in ("images", "depth"):
        (recording / name).mkdir(parents=True)
    with bag:
        for i, pose in enumerate(true):
            frame = simulator.render(pose)
            rgb, steps = sensed(np.asarray(frame.rgb), np.asarray(frame.depth), i)
            jpeg, png = encoded(rgb, "jpeg"), encoded(steps, "png")
            (recording / "images" / f"{i:04d}.jpg").write_bytes(jpeg)
            (recording / "depth" / f"{i:04d}.png").write_bytes(png)
            bag.frame(START + i * PERIOD, jpeg, png, given[i])
            print(f"\r{i + 1} of {FRAMES}", end="", flush=True)
    K = [[CAMERA.fx, 0, CAMERA.cx - 0.5], [0, CAMERA.fy, CAMERA.cy - 0.5], [0, 0, 1]]
    np.savetxt(recording / "K.txt", np.array(K, float))
    np.savetxt(recording / "poses.txt", given.reshape(-1, 16))
    print()


class Bag:
    """A bag of ROS 2; a context manager."""

    def __init__(self, path: Path):
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
        self._store: Any = get_typestore(Stores.ROS2_HUMBLE)
        tf = "tf2_msgs/msg/TFMessage"
        if tf not in self._store.types:
            text = "geometry_msgs/TransformStamped[] transforms"
            self._store.register(get_types_from_msg(text, tf))
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> "Bag":
        self._writer.open()
        self._moves("/tf_static", START, [("base_link", "camera", T_BASE_CAMERA)])
        return self

    def __exit__(self, *_: Any) -> None:
        self._writer.close()

    def frame(self, time: int, jpeg: bytes, png: bytes, T_map_camera: np.ndarray) -> None:
        """Writes one frame, its transform and its cameras."""
        T_map_odom = np.eye(4)
        T_map_odom[:3, 3] = 1.0, -0.5, 0.0
        T_odom_base = np.linalg.inv(T_map_odom) @ T_map_camera @ np.linalg.inv(T_BASE_CAMERA)
        moves = [("map", "odom", T_map_odom), ("odom", "base_link", T_odom_base)]
        self._moves("/tf", time, moves)
        for name in ("color", "depth"):
            self._send(
                f"/camera/{name}/camera_info", "sensor_msgs/msg/CameraInfo", time, self._info
            )
        kind, head = "sensor_msgs/msg/CompressedImage", struct.pack("<iff", 0, 0.0, 0.0)
        stored = {"format": "rgb8; jpeg compressed bgr8", "data": np.frombuffer(jpeg, np.uint8)}
        self._send("/camera/color/image_raw/compressed", kind, time, stored)
        data = np.frombuffer(head + png, np.uint8)
        stored = {"format": "16UC1; compressedDepth png", "data": data}
        self._send("/camera/depth/image_rect_raw/compressedDepth", kind, time, stored)

    @property
    def _info(self) -> dict[str, Any]:
        K = np.array([CAMERA.fx, 0, CAMERA.cx - 0.5, 0, CAMERA.fy, CAMERA.cy - 0.5, 0, 0, 1], float)
        P = np.insert(K, [3, 6, 9], 0.0)
        return {"height": CAMERA.height, "width": CAMERA.width, "distortion_model": "plumb_bob",
                "d": np.zeros(5), "k": K, "r": np.eye(3).ravel(), "p": P}  # fmt: skip

    def _moves(self, topic: str, time: int, moves: list[tuple[str, str, np.ndarray]]) -> None:
        stamped = [
            {
                "header": _header(parent, time),
                "child_frame_id": child,
                "transform": {
                    "translation": dict(zip("xyz", T[:3, 3].tolist(), strict=True)),
                    "rotation": dict(
                        zip("xyzw", Rotation.from_matrix(T[:3, :3]).as_quat().tolist(), strict=True)
                    ),
                },
            }
            for parent, child, T in moves
        ]
        self._send(topic, "tf2_msgs/msg/TFMessage", time, {"transforms": stamped})

    def _send(self, topic: str, kind: str, time: int, fields: dict[str, Any]) -> None:
        if topic not in self._connections:
            new = self._writer.add_connection(topic, kind, typestore=self._store)
            self._connections[topic] = new
        message = self._message(kind, {"header": _header("camera", time), **fields})
        data = self._store.serialize_cdr(message, kind)
        self._writer.write(self._connections[topic], time, data)

    def _message(self, kind: str, fields: dict[str, Any]) -> Any:
        """A message from nested dictionaries; what they lack is zero."""
        values: dict[str, Any] = {}
        for name, (node, detail) in self._store.fielddefs[kind][1]:
            value = fields.get(name, {} if node == 2 else 0)  # 2: a message in the message
            if isinstance(value, dict):
                value = self._message(detail, value)
            elif isinstance(value, list):
                value = [self._message(detail[0][1], one) for one in value]
            values[name] = value
        return self._store.types[kind](**values)


def _header(frame: str, time: int) -> dict[str, Any]:
    stamp = {"sec": time // SECOND, "nanosec": time % SECOND}
    return {"stamp": stamp, "frame_id": frame}


if __name__ == "__main__":
    write(Path(sys.argv[1]))
