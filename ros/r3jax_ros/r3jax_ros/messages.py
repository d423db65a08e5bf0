"""Messages of ROS from and to arrays."""

from array import array

import numpy as np
from geometry_msgs.msg import Point, Pose
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

import r3jax


def matrix_of(position, turn) -> np.ndarray:
    """The matrix [4, 4] of a message's position and quaternion."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    T[:3, 3] = position.x, position.y, position.z
    return T


def pose_of(T: np.ndarray) -> Pose:
    """The message of a matrix [4, 4]."""
    pose = Pose()
    pose.position.x, pose.position.y, pose.position.z = T[:3, 3].tolist()
    turn = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = turn
    return pose


class Costmap:
    """Costs of places on the floor: Nav2's `OccupancyGrid`."""

    def __init__(self, message) -> None:
        """Reads a message; its cells begin at its origin, whose frame is the world's."""
        info = message.info
        self.frame = message.header.frame_id
        self.cost = np.reshape(np.asarray(message.data, np.int16), (info.height, info.width))
        T_world_map = matrix_of(info.origin.position, info.origin.orientation)
        self.origin, self.resolution = T_world_map[:2, 3], float(info.resolution)
        self.is_aligned = bool(np.allclose(T_world_map[:3, :3], np.eye(3), atol=1e-6))
        self._T_map_world = np.linalg.inv(T_world_map)

    def at(self, points: np.ndarray) -> np.ndarray:
        """Cost at points [n, 2 or 3] [m], 0 to 100; -1 where it is unknown or beyond the map."""
        flat = np.concatenate([points[:, :2], np.zeros((len(points), 1))], axis=1)
        local = flat @ self._T_map_world[:3, :3].T + self._T_map_world[:3, 3]
        column, row = np.floor(local[:, :2] / self.resolution).astype(int).T
        height, width = self.cost.shape
        is_in = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        found = self.cost[np.where(is_in, row, 0), np.where(is_in, column, 0)]
        return np.where(is_in, found, -1)


def cloud_of(header: Header, points: np.ndarray, colors: np.ndarray) -> PointCloud2:
    """Points [n, 3] with colors [n, 3] uint8, packed into `rgb` as RViz shows them."""
    packed = np.zeros(len(points), [("xyz", "<f4", 3), ("bgr", "u1", 3), ("pad", "u1")])
    packed["xyz"], packed["bgr"] = points, colors[:, ::-1]
    fields = [PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1) for
              i, name in enumerate(("x", "y", "z", "rgb"))]  # fmt: skip
    return PointCloud2(
        header=header, height=1, width=len(points), fields=fields, is_bigendian=False,
        point_step=16, row_step=16 * len(points), data=array("B", packed.tobytes()), is_dense=True,
    )  # fmt: skip


def markers_of(header: Header, decision: r3jax.Decision) -> MarkerArray:
    """The path to the goal, and all candidates: the greener, the better."""
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
