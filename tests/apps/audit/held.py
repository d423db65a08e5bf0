"""Ray-cast places with z up, and the ways in which cameras are held in them.

A place is a convex room (planes), and boxes turned in any way in it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from r3jax.geometry.cameras import Camera
from tests.formats.colmap_models import random_rotation

Plane = tuple[np.ndarray, float]
"""Normal and offset: inside is where n . x is smaller."""

Box = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Middle, half of the edges, rotation."""


def about(axis: int, degrees: float) -> np.ndarray:
    """A rotation [3, 3] about an axis."""
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    R, a = np.eye(3), np.radians(degrees)
    R[i, i] = R[j, j] = np.cos(a)
    R[i, j], R[j, i] = -np.sin(a), np.sin(a)
    return R


def held_pose(eye: Sequence[float], yaw: float, pitch: float, roll: float = 0.0) -> np.ndarray:
    """`T_world_camera` [4, 4] of a camera that looks along y, turned, tilted and rolled [deg]."""
    forward_is_y = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    pose = np.eye(4)
    pose[:3, :3] = about(2, yaw) @ forward_is_y @ about(0, pitch) @ about(2, roll)
    pose[:3, 3] = eye
    return pose


def turned(poses: np.ndarray, R: np.ndarray) -> np.ndarray:
    """The poses [n, 4, 4] in a world that is turned."""
    T = np.eye(4)
    T[:3, :3] = R
    return T @ poses


@dataclass
class Place:
    """What can be seen."""

    walls: Sequence[Plane] = ()
    boxes: Sequence[Box] = field(default_factory=list)
    noise: float = 0.004
    """Of the inverse depth [1/m]: a Kinect's."""

    def depth(self, pose: np.ndarray, camera: Camera, seed: int) -> np.ndarray:
        """z-depth [H, W] float32; 0 where there is nothing."""
        shape = (camera.height, camera.width)
        row, column = np.mgrid[: shape[0], : shape[1]] + 0.5
        x = (column - float(camera.cx)) / float(camera.fx)
        y = (row - float(camera.cy)) / float(camera.fy)
        ray = np.stack([x, y, np.ones_like(x)], axis=2) @ pose[:3, :3].T
        eye = pose[:3, 3]
        z = np.full(shape, np.inf)
        with np.errstate(divide="ignore", invalid="ignore"):
            for normal, offset in self.walls:
                along = ray @ normal
                at = (offset - eye @ normal) / along
                z = np.where((along > 0.0) & (at > 0.0), np.minimum(z, at), z)
            for middle, half, R in self.boxes:
                to_middle, along = (middle - eye) @ R, ray @ R
                sides = (to_middle - half) / along, (to_middle + half) / along
                first, last = np.minimum(*sides).max(axis=2), np.maximum(*sides).min(axis=2)
                z = np.where((first > 1e-3) & (first < last), np.minimum(z, first), z)
        patches = np.random.default_rng(seed).normal(size=(shape[0] // 2, shape[1] // 2))
        inverse = 1.0 / z + self.noise * np.kron(patches, np.ones((2, 2)))
        return np.where(np.isfinite(z) & (inverse > 0.0), 1.0 / inverse, 0.0).astype(np.float32)


def room(x: float, y: float, z: float, roof: float | None = None) -> list[Plane]:
    """Walls, floor and ceiling; or a gable roof along y, of an inclination [deg]."""
    sides = [(-np.eye(3)[i], 0.0) for i in range(3)]
    sides += [(np.eye(3)[i], float((x, y, z)[i])) for i in range(3)]
    if roof is not None:
        a = np.radians(roof)
        for sign, edge in ((-1.0, 0.0), (1.0, x)):
            normal = np.array([sign * np.sin(a), 0.0, np.cos(a)])
            sides.append((normal, float(normal @ [edge, 0.0, 0.8])))
    return sides


def box(low: Sequence[float], high: Sequence[float], degrees: float = 0.0) -> Box:
    """A box that stands upright."""
    a, b = np.asarray(low, float), np.asarray(high, float)
    return (a + b) / 2, (b - a) / 2, about(2, degrees)


def clutter(draw: np.random.Generator, low: Sequence[float], high: Sequence[float]) -> list[Box]:
    """Boxes that lie anyhow."""
    return [
        (draw.uniform(low, high), draw.uniform(0.05, 0.35, 3), random_rotation(draw))
        for _ in range(40)
    ]


FURNITURE = [
    box([2, 1.4, 0.75], [3.2, 2.3, 0.8]),
    box([4.3, 0, 0], [5, 0.7, 1.8]),
    box([0.2, 2.5, 0], [1.0, 3.5, 0.5], 20),
]
Case = Callable[[np.random.Generator], tuple[Place, list[np.ndarray]]]


def _wander(
    draw: np.random.Generator, pitch: float, roll: Callable[[int], float]
) -> list[np.ndarray]:
    """Anywhere in a room of 5 x 4 m, turned anyhow."""
    return [
        held_pose(
            [draw.uniform(1.8, 3.2), draw.uniform(0.8, 3.2), 1.4 + 0.1 * draw.normal()],
            draw.uniform(0, 360),
            pitch + 8 * draw.normal(),
            roll(i) + 3 * draw.normal(),
        )
        for i in range(24)
    ]


def _axes_in_turn(draw: np.random.Generator) -> list[np.ndarray]:
    """Looks down by 40 degrees, and turns about its own axes in turn (TUM's freiburg1_rpy)."""
    down, poses = held_pose([2.6, 0.5, 1.6], 0.0, -40.0), []
    for axis, most in ((2, 45), (0, 25), (1, 35)):
        for angle in np.r_[np.linspace(0, most, 4), np.linspace(most, -most, 7)]:
            pose = down.copy()
            pose[:3, :3] = down[:3, :3] @ about(axis, angle)
            pose[:3, 3] += 0.04 * draw.normal(size=3)
            poses.append(pose)
    return poses


def _over_desk(draw: np.random.Generator, pitch: float) -> list[np.ndarray]:
    return [
        held_pose([2.6 + 0.3 * np.sin(i), 0.7, 1.5], 8 * draw.normal(), pitch + 4 * draw.normal(),
                  3 * draw.normal())
        for i in range(20)
    ]  # fmt: skip


def _orbit(draw: np.random.Generator) -> list[np.ndarray]:
    return [
        held_pose((about(2, a) @ [0, -0.8, 0.3]).tolist(), a, -20, 0.5 * draw.normal())
        for a in range(0, 360, 15)
    ]


def _from_above(draw: np.random.Generator) -> list[np.ndarray]:
    return [
        held_pose([x, y, 25], draw.uniform(0, 360), -88 + 2 * draw.normal())
        for x in (-12, -4, 4, 12)
        for y in (-12, -4, 4, 12)
    ]


def _houses(draw: np.random.Generator) -> list[Box]:
    houses = []
    for x, y in draw.uniform(-18, 18, (8, 2)):
        side, turn = draw.uniform(3, 5), about(2, draw.uniform(0, 360))
        houses.append((np.array([x, y, 2.0]), np.array([side, 1.3 * side, 2.0]), turn))
        roof = turn @ about(1, 45)
        houses.append((np.array([x, y, 4.0]), np.array([0.7, 1.32, 0.7]) * side, roof))
    return houses


ROOM = room(5, 4, 2.5)
CASES: dict[str, Case] = {
    "walked about": lambda draw: (
        Place(ROOM, FURNITURE), _wander(draw, -10, lambda i: 0.0)),
    "turned about its own axes in turn": lambda draw: (
        Place(ROOM, FURNITURE), _axes_in_turn(draw)),
    "a phone turned from landscape to portrait": lambda draw: (
        Place(ROOM, FURNITURE), _wander(draw, -8, lambda i: 0.0 if i < 10 else 90.0)),
    "down at a desk": lambda draw: (
        Place(ROOM, [*FURNITURE, box([2.2, 2.1, 0.75], [2.9, 2.2, 1.2], 15)]),
        _over_desk(draw, -48)),
    "under a sloped roof": lambda draw: (
        Place(room(5, 4, 3.0, roof=draw.uniform(35, 50)), [box([2, 2, 0], [3, 3, 0.5])]),
        _wander(draw, -5, lambda i: 0.0)),
    "clutter without a floor": lambda draw: (
        Place(room(6, 6, 2.6), clutter(draw, [0.3, 3, 0.3], [5.7, 5.8, 2.2])),
        [held_pose([draw.uniform(1.5, 4.5), 1, 1.3], 20 * draw.normal(), 2 + 6 * draw.normal(),
                   3 * draw.normal()) for _ in range(20)]),
    "an object on a turntable": lambda draw: (
        Place((), [(np.zeros(3), np.array([0.2, 0.03, 0.15]), random_rotation(draw))]),
        _orbit(draw)),
    "a drone that looks straight down": lambda draw: (
        Place([(np.array([0, 0, -1.0]), 0.0)], _houses(draw), noise=2e-5), _from_above(draw)),
}  # fmt: skip
"""Places, and poses of a camera in them, by what is odd."""
