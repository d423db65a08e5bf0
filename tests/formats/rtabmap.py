"""The room of the audit's tests, mapped by RTAB-Map: its database, and what it exports."""

import sqlite3
import struct
import tempfile
import zlib
from pathlib import Path

import numpy as np

from r3jax.formats.poses import quaternion_of
from tests.formats.bags import T_BASE_LINK, T_LINK_OPTICAL, camera_poses, rvl
from tests.formats.phones import LENS, depth_steps, room_poses, view
from tests.formats.sequences import encoded

T_ROBOT_CAMERA = T_BASE_LINK @ T_LINK_OPTICAL

DEPTHS = ("mm", "meters", "rvl")
"""Ways to store depth; the nodes take one after the other."""

CALIBRATION = """%YAML:1.0
---
camera_name: "{id}"
image_width: {width}
image_height: {height}
camera_matrix:
   rows: 3
   cols: 3
   data: [ {fx}, 0., {cx}, 0., {fy}, {cy}, 0., 0., 1. ]
distortion_coefficients:
   rows: 1
   cols: 5
   data: [ 0.1, 0., 0., 0., 0. ]
distortion_model: plumb_bob
local_transform:
   rows: 3
   cols: 4
   data: [ 0., 0., 1., 0., -1., 0., 0., 0., 0., -1., 0., 1.19 ]
"""


def export() -> dict[str, bytes]:
    """`rtabmap-export --images_id --poses_camera --poses_format 11 --output scan`."""
    files: dict[str, bytes] = {}
    lines = ["#timestamp x y z qx qy qz qw id"]
    fx, fy, cx, cy = LENS.params
    text = CALIBRATION.format(
        id=1, width=LENS.width, height=LENS.height, fx=fx, fy=fy, cx=cx - 0.5, cy=cy - 0.5
    )
    for i, pose in enumerate(camera_poses()):
        number = 3 + 7 * i
        w, x, y, z = quaternion_of(pose[:3, :3])
        numbers = [1.7e9 + i, *pose[:3, 3], x, y, z, w]
        lines.append(" ".join(f"{value:.9f}" for value in numbers) + f" {number}")
        files[f"scan_rgb/{number}.jpg"] = encoded(view(room_poses()[i], LENS)[0], "jpeg")
        files[f"scan_depth/{number}.png"] = encoded(depth_steps(room_poses()[i]))
        files[f"scan_calib/{number}.yaml"] = text.encode()
    return files | {"scan_camera_poses.txt": "\n".join(lines).encode(), "scan_cloud.ply": b"ply"}


def stored_depth(pose: np.ndarray, how: str) -> bytes:
    """A depth image as the database holds it."""
    steps = depth_steps(pose)
    if how == "mm":
        return encoded(steps)
    if how == "rvl":
        return b"DEPTHRVL" + rvl(steps)
    meters = np.where(steps == 0, np.float32(np.nan), steps.astype(np.float32) / 1000)
    blue_first = meters.astype("<f4").view(np.uint8).reshape(*steps.shape, 4)
    return encoded(np.ascontiguousarray(blue_first[..., [2, 1, 0, 3]]))


def calibration() -> bytes:
    """A camera as RTAB-Map serializes it, with the distortion that its images have no more."""
    fx, fy, cx, cy = LENS.params
    K = [fx, 0, cx - 0.5, 0, fy, cy - 0.5, 0, 0, 1]
    P = [fx, 0, cx - 0.5, 0, 0, fy, cy - 0.5, 0, 0, 0, 1, 0]
    header = struct.pack("<11i", 0, 21, 4, 0, LENS.width, LENS.height, 9, 5, 9, 12, 12)
    numbers = np.array([*K, *[0.1] * 5, *np.eye(3).ravel(), *P], "<f8")
    return header + numbers.tobytes() + T_ROBOT_CAMERA[:3].astype("<f4").tobytes()


def compressed(array: np.ndarray, kind: int) -> bytes:
    """A matrix as RTAB-Map compresses it."""
    return zlib.compress(array.tobytes()) + struct.pack("<3i", 1, array.size, kind)


def database(optimized: bool = True) -> bytes:
    """A map of four nodes; with an optimized graph the odometry has drifted, and a node is lost."""
    robot = camera_poses() @ np.linalg.inv(T_ROBOT_CAMERA)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.db"
        connection = sqlite3.connect(path)
        connection.execute("CREATE TABLE Node (id INTEGER PRIMARY KEY, stamp FLOAT, pose BLOB)")
        connection.execute(
            "CREATE TABLE Data (id INTEGER PRIMARY KEY, image BLOB, depth BLOB, calibration BLOB)"
        )
        connection.execute("CREATE TABLE Link (from_id INTEGER, to_id INTEGER, type INTEGER)")
        connection.execute("CREATE TABLE Admin (version TEXT, opt_ids BLOB, opt_poses BLOB)")
        for i, T in enumerate(robot):
            drifted = T.copy()
            drifted[:3, 3] += 0.3 * optimized
            room = room_poses()[i]
            image = encoded(view(room, LENS)[0], "png")
            depth = stored_depth(room, DEPTHS[i % len(DEPTHS)])
            pose = drifted[:3].astype("<f4").tobytes()
            connection.execute("INSERT INTO Node VALUES (?, ?, ?)", (5 + i, 1.7e9 + i, pose))
            row = (5 + i, image, depth, calibration())
            connection.execute("INSERT INTO Data VALUES (?, ?, ?, ?)", row)
        graph = (None, None)
        if optimized:
            ids, poses = np.arange(5, 8, dtype="<i4"), robot[:3, :3].astype("<f4")
            graph = compressed(ids, 4), compressed(poses.ravel(), 5)
        connection.execute("INSERT INTO Admin VALUES (?, ?, ?)", ("0.21.4", *graph))
        connection.commit()
        connection.close()
        return path.read_bytes()
