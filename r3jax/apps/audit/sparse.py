"""Sparse depth images from points, for captures without depth.

Where a structure from motion says which image sees which point, that is taken; of a mere cloud
(nerfstudio's `ply_file_path`) an image sees the points that no nearer one hides.

Shape symbols: m points; H, W image size.
"""

import numpy as np

from r3jax.geometry.cameras import Camera

_BLOCKS_ACROSS = 80
"""Blocks per row of an image, in which the nearest point of a cloud hides the others."""

_SLACK = 1.05
"""Points at most this many times as far as the nearest one of their block are seen."""


def sparse_depth(
    camera: Camera, pose: np.ndarray, xyz: np.ndarray, rgb: np.ndarray, *, hides: bool
) -> tuple[np.ndarray, np.ndarray]:
    """z-depth [H, W] float32 of the points that an image shows, and their colors [H, W, 3] uint8.

    Args:
        camera: of the image.
        pose: `T_world_camera`, [4, 4], in the points' coordinates.
        xyz: points, [m, 3].
        rgb: their colors, [m, 3] uint8.
        hides: True if a point hides those behind it.

    Returns:
        0 and black in pixels without a point; the nearest one where there are several.
    """
    shape = (camera.height, camera.width)
    depth, colors = np.full(shape, np.inf, np.float32), np.zeros((*shape, 3), np.uint8)
    local = (xyz - pose[:3, 3]) @ pose[:3, :3]
    z = local[:, 2]
    z_safe = np.where(z > 0.0, z, 1.0)
    column = np.floor(float(camera.fx) * local[:, 0] / z_safe + float(camera.cx))
    row = np.floor(float(camera.fy) * local[:, 1] / z_safe + float(camera.cy))
    is_in = (z > 0.0) & (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    kept = np.flatnonzero(is_in)
    row, column, z = row[kept].astype(np.int64), column[kept].astype(np.int64), z[kept]
    if hides and len(kept):
        side = max(1, round(shape[1] / _BLOCKS_ACROSS))
        wide = -(-shape[1] // side)
        block = (row // side) * wide + column // side
        nearest = np.full(wide * -(-shape[0] // side), np.inf)
        np.minimum.at(nearest, block, z)
        is_front = z <= _SLACK * nearest[block]
        kept, row, column, z = kept[is_front], row[is_front], column[is_front], z[is_front]
    order = np.argsort(-z, kind="stable")  # the nearest is written last
    depth[row[order], column[order]] = z[order]
    colors[row[order], column[order]] = rgb[kept[order]]
    return np.where(np.isfinite(depth), depth, np.float32(0.0)), colors
