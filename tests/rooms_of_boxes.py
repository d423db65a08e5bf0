"""What a camera measures in a room with boxes, in closed form."""

from collections.abc import Sequence

import numpy as np

import r3jax
from r3jax.geometry.cameras import pixel_rays

ROOM = np.array([[-2.5, -2.0, 0.0], [2.5, 2.0, 2.6]])
"""Lower and upper corner [m]."""


def pose_at(position: Sequence[float], yaw: float, pitch: float) -> np.ndarray:
    """A level pose [4, 4] that looks along a heading and an elevation [deg]."""
    yaw, pitch = np.deg2rad([yaw, pitch])
    ahead = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    return np.asarray(r3jax.pose_along(np.asarray(position), ahead), np.float64)


def depth_in_room(
    camera: r3jax.Camera,
    pose: np.ndarray,
    boxes: Sequence[np.ndarray] = (),
    room: np.ndarray = ROOM,
) -> np.ndarray:
    """z-depth [H, W] of the nearest box, or of the room's own walls."""
    rays = np.asarray(pixel_rays(camera), np.float64) @ pose[:3, :3].T
    position = pose[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (np.where(rays > 0, room[1], room[0]) - position) / rays
        depth = depth.min(axis=2)
        for low, high in boxes:
            first = (np.where(rays > 0, low, high) - position) / rays
            last = (np.where(rays > 0, high, low) - position) / rays
            begin, end = first.max(axis=2), last.min(axis=2)
            depth = np.where((begin <= end) & (begin > 0.0), np.minimum(depth, begin), depth)
    return depth


def frame_in_room(
    camera: r3jax.Camera,
    pose: np.ndarray,
    boxes: Sequence[np.ndarray] = (),
    noise: float = 0.0,
    seed: int = 0,
    room: np.ndarray = ROOM,
) -> r3jax.Frame:
    """A gray frame, with depth off by a share of itself (standard deviation)."""
    depth = depth_in_room(camera, pose, boxes, room)
    depth *= 1.0 + noise * np.random.default_rng(seed).normal(size=depth.shape)
    rgb = np.full((camera.height, camera.width, 3), 0.5, np.float32)
    return r3jax.Frame(rgb, depth.astype(np.float32), pose, camera)
