"""What is drawn of a run beside its voxels: the path, frusta, recorded points, splats.

Shape symbols: n points or Gaussians; s segments; C candidates.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from r3jax.apps.viewer.color_maps import ORDER, paint
from r3jax.exploration.taken_views import StepRow
from r3jax.geometry.cameras import Camera
from r3jax.kernels.constants import SH0
from r3jax.runs.reader import Run
from r3jax.runs.rows import paths_to
from r3jax.splatting.scene import GaussianScene

POINT_BUDGET = 200_000
"""Recorded points that are drawn at most."""

SPLAT_BUDGET = 300_000
"""Gaussians that a browser gets at most."""


def path_segments(rows: Sequence[StepRow], num_views: int) -> tuple[np.ndarray, np.ndarray]:
    """Computes the path that the camera flew, segment by segment.

    Args:
        rows: of the trace from the first one on, as many as are to be drawn.
        num_views: of the whole run, over which the colors run.

    Returns:
        Ends [s, 2, 3] float32 [m], and their colors by order [s, 2, 3] uint8.
    """
    ends, order = [np.zeros((0, 2, 3))], [np.zeros(0)]
    for row, path in zip(rows, paths_to(rows), strict=True):
        if path is None:
            continue
        ends.append(np.stack([path[:-1], path[1:]], axis=1))
        order.append(np.full(len(path) - 1, row.step / max(num_views - 1, 1)))
    colors = paint(np.concatenate(order), ORDER)
    return np.concatenate(ends).astype(np.float32), np.repeat(colors[:, None], 2, axis=1)


def frustum_corners(camera: Camera, T_world_camera: np.ndarray, depth: float) -> np.ndarray:
    """Returns the image's corners at a distance ahead of the camera, in order, [4, 3] [m]."""
    columns = np.array([0.0, camera.width, camera.width, 0.0])
    rows = np.array([0.0, 0.0, camera.height, camera.height])
    x = (columns - float(camera.cx)) / float(camera.fx)
    y = (rows - float(camera.cy)) / float(camera.fy)
    corners = depth * np.stack([x, y, np.ones(4)], axis=1)
    return corners @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]


def frustum_segments(camera: Camera, T_world_camera: np.ndarray, depth: float) -> np.ndarray:
    """Returns a camera's pyramid, its edges and a tick on its upper side, [9, 2, 3] float32 [m]."""
    corners = frustum_corners(camera, T_world_camera, depth)
    apex = np.repeat(T_world_camera[None, :3, 3], 4, axis=0)
    sides = np.stack([apex, corners], axis=1)
    rim = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
    middle = corners[:2].mean(axis=0)
    tick = np.stack([middle, middle + 0.4 * (corners[0] - corners[3])])[None]
    return np.concatenate([sides, rim, tick]).astype(np.float32)


def recorded_points(run: Run, budget: int = POINT_BUDGET) -> tuple[np.ndarray, np.ndarray]:
    """Measured points of all frames in their recorded colors, the same number of each frame.

    Args:
        run: the run.
        budget: points at most.

    Returns:
        Points [n, 3] float32 [m] and colors [n, 3] uint8.

    Raises:
        RunError: a frame is missing, broken, or not the one that was recorded.
    """
    points, colors = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.uint8)]
    share = max(1, budget // max(len(run.rows), 1))
    camera = run.camera
    for row in run.rows:
        frame = run.frame(row.step)
        depth, rgb = np.asarray(frame.depth), np.asarray(frame.rgb)
        v, u = np.nonzero((depth > 0.0) & np.isfinite(depth))
        # Drawn for each view: a fixed pattern would show as lines.
        chosen = np.random.default_rng(row.step).permutation(len(v))[:share]
        v, u = v[chosen], u[chosen]
        z = depth[v, u]
        x = (u + 0.5 - float(camera.cx)) / float(camera.fx) * z
        y = (v + 0.5 - float(camera.cy)) / float(camera.fy) * z
        world = np.stack([x, y, z], axis=1) @ row.pose[:3, :3].T + row.pose[:3, 3]
        points.append(world.astype(np.float32))
        colors.append(np.rint(rgb[v, u] * 255.0).astype(np.uint8))
    return np.concatenate(points)[:budget], np.concatenate(colors)[:budget]


def splat_arrays(
    scene: GaussianScene, budget: int = SPLAT_BUDGET
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Gaussians as a browser draws them: without view-dependent color, the largest ones first.

    Args:
        scene: the splats.
        budget: Gaussians at most.

    Returns:
        Centers [n, 3] [m], covariances [n, 3, 3] [m^2], colors [n, 3] and opacities [n, 1] in
        [0, 1], float32 all.
    """
    alive = np.flatnonzero(np.asarray(scene.is_alive))
    logits = np.asarray(scene.opacity_logits, dtype=np.float64)[alive]
    opacity = 1.0 / (1.0 + np.exp(-logits))
    scales = np.exp(np.asarray(scene.log_scales, dtype=np.float64)[alive])
    if len(alive) > budget:
        # What covers most: opacity times the area of the two longer axes.
        area = scales.prod(axis=1) / scales.min(axis=1)
        best = np.sort(np.argsort(-opacity * area, kind="stable")[:budget])
        alive, opacity, scales = alive[best], opacity[best], scales[best]
    axes = _matrices(np.asarray(scene.quats, dtype=np.float64)[alive]) * scales[:, None, :]
    rgb = np.asarray(scene.sh, dtype=np.float64)[alive, 0] * SH0 + 0.5
    arrays = (
        np.asarray(scene.means)[alive],
        axes @ axes.transpose(0, 2, 1),
        rgb.clip(0.0, 1.0),
        opacity[:, None],
    )
    centers, covariances, colors, opacities = (x.astype(np.float32) for x in arrays)
    return centers, covariances, colors, opacities


def _matrices(wxyz: np.ndarray) -> np.ndarray:
    """Converts quaternions [..., 4] of any length but 0 to rotation matrices [..., 3, 3]."""
    return Rotation.from_quat(wxyz, scalar_first=True).as_matrix()


def quaternion(R: np.ndarray) -> tuple[float, float, float, float]:
    """Converts a rotation matrix [3, 3] to the unit quaternion wxyz, w >= 0."""
    w, x, y, z = Rotation.from_matrix(R).as_quat(canonical=True, scalar_first=True).tolist()
    return w, x, y, z


def pose_of(wxyz: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Returns `T_world_camera` [4, 4] float64 of a quaternion wxyz and a position [m]."""
    pose = np.eye(4)
    pose[:3, :3] = _matrices(wxyz)
    pose[:3, 3] = position
    return pose
