"""Maps of robots: a database as RTAB-Map 0.21 writes it, one that kept no pictures, bags."""

import sqlite3
import struct
import tempfile
from pathlib import Path

import numpy as np

from tests.formats.real.layouts import NUM, POSES, Files, Layout, depth_png, lfs_pointer, picture

SIZE = (64, 48)

_NODE = """CREATE TABLE Node (
	id INTEGER NOT NULL,
	map_id INTEGER NOT NULL,
	weight INTEGER,
	stamp FLOAT,
	pose BLOB,                -- 3x4 float
	ground_truth_pose BLOB,   -- 3x4 float
	velocity BLOB,            -- 6 float (vx,vy,vz,vroll,vpitch,vyaw) m/s and rad/s
	label TEXT,
	gps BLOB,
	env_sensors BLOB,
	time_enter DATE,
	PRIMARY KEY (id)
)"""
_DATA = """CREATE TABLE Data (
	id INTEGER NOT NULL,
	image BLOB,               -- compressed image (Grayscale or RGB)
	depth BLOB,               -- compressed image (Depth or Right image)
	calibration BLOB,         -- fx, fy, cx, cy, [baseline,] width, height, local_transform
	
	scan BLOB,
	scan_info BLOB,
	ground_cells BLOB,
	obstacle_cells BLOB,
	empty_cells BLOB,
	cell_size FLOAT,
	view_point_x FLOAT,
	view_point_y FLOAT,
	view_point_z FLOAT,
	user_data BLOB,
	time_enter DATE,
	PRIMARY KEY (id)
)"""
_REST = (
    "CREATE TABLE Link (from_id INTEGER NOT NULL, to_id INTEGER NOT NULL, type INTEGER NOT NULL,"
    " information_matrix BLOB NOT NULL, transform BLOB, user_data BLOB)",
    "CREATE TABLE Word (id INTEGER NOT NULL, descriptor_size INTEGER NOT NULL,"
    " descriptor BLOB NOT NULL, time_enter DATE, PRIMARY KEY (id))",
    "CREATE TABLE Feature (node_id INTEGER NOT NULL, word_id INTEGER NOT NULL)",
    "CREATE TABLE Statistics (id INTEGER NOT NULL, stamp FLOAT, data BLOB, wm_state BLOB)",
    "CREATE TABLE Admin (version TEXT, preview_image BLOB, opt_cloud BLOB, opt_ids BLOB,"
    " opt_poses BLOB, opt_last_localization BLOB, opt_map BLOB, time_enter DATE)",
    "CREATE INDEX IDX_Feature_node_id on Feature (node_id)",
)
_T_ROBOT_CAMERA = np.array(
    [[0.0, 0.0, 1.0, 0.1], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.4], [0.0, 0.0, 0.0, 1.0]]
)


def _calibration() -> bytes:
    """Version 0.21.1 of the camera, 372 bytes; its principal point counts from pixel centers."""
    K = [70.0, 0, 30.5, 0, 71.0, 24.5, 0, 0, 1]
    P = [70.0, 0, 30.5, 0, 0, 71.0, 24.5, 0, 0, 0, 1, 0]
    head = struct.pack("<11i", 0, 21, 1, 0, *SIZE, 9, 5, 9, 12, 12)
    numbers = np.array([*K, *[0.0] * 5, *np.eye(3).ravel(), *P], "<f8").tobytes()
    return head + numbers + _T_ROBOT_CAMERA[:3].astype("<f4").tobytes()


def _database(version: str = "0.21.1", pictures: bool = True) -> Files:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rtabmap.db"
        connection = sqlite3.connect(path)
        for statement in (_NODE, _DATA, *_REST):
            connection.execute(statement)
        row: tuple[object, ...]
        for i in range(NUM):
            robot = (POSES[i] @ np.linalg.inv(_T_ROBOT_CAMERA))[:3].astype("<f4").tobytes()
            row = (1 + i, 0, -9 * (i > 0), 1702296897.4 + i, robot, None, bytes(24), None, None)
            connection.execute(f"INSERT INTO Node VALUES ({', '.join('?' * 11)})",
                               (*row, None, "2023-12-11 12:15:22"))  # fmt: skip
            kept = (picture(i, SIZE), depth_png(i, SIZE), _calibration())
            row = (1 + i, *(kept if pictures else (None, None, None)), *[None] * 5)
            connection.execute(f"INSERT INTO Data VALUES ({', '.join('?' * 15)})",
                               (*row, 0.01, 0.0, 0.0, 0.0, None, None))  # fmt: skip
        connection.execute("INSERT INTO Admin (version) VALUES (?)", (version,))
        connection.commit()
        connection.close()
        return {"rtabmap.db": path.read_bytes()}


LAYOUTS = (
    Layout("RTAB-Map 0.21", _database, given="rtabmap.db", size=SIZE, up=(0.0, 0.0, 1.0),
           intrinsics=(70.0, 71.0, 31.0, 25.0), poses_off=1e-5, remark=("odometry",)),
)  # fmt: skip


def without_pictures() -> Files:
    """411 nodes and no picture, as with Mem/BinDataKept false."""
    return _database("0.21.10", pictures=False)


def pointers() -> dict[str, Files]:
    """Clones without Git LFS."""
    names = ("rtabmap.db", "demo.bag", "demo.mcap", "scan_0.db3", "scan.r3d", "scene0000_00.sens")
    return {name: {name: lfs_pointer()} for name in names}
