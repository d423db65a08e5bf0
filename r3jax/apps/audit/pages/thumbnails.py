"""Small pictures for pages."""

import io

import numpy as np
from PIL import Image


def small_png(rgb: np.ndarray, pose: np.ndarray, up: np.ndarray, side: int) -> bytes:
    """A small PNG of an image, turned by quarters until the vertical points up.

    Args:
        rgb: colors, [H, W, 3] uint8.
        pose: `T_world_camera`, [4, 4].
        up: the vertical, [3] in the same world.
        side: longer side at most [px].
    """
    right, down = (pose[:3, :3].T @ up)[:2]
    turns = round(float(np.degrees(np.arctan2(right, -down))) / 90.0)
    picture = Image.fromarray(np.ascontiguousarray(np.rot90(rgb, turns)))
    picture.thumbnail((side, side))
    return png(np.asarray(picture))


def png(rgb: np.ndarray) -> bytes:
    """A PNG of an image [H, W, 3] uint8."""
    buffer = io.BytesIO()
    Image.fromarray(rgb).save(buffer, format="png", compress_level=1)
    return buffer.getvalue()
