"""Depth images whose size, camera or confidence is not that of the colors.

Phones measure depth with few pixels (256 x 192) beside large images (1920 x 1440). Depth is brought
to the image's pixels by its nearest pixel, never interpolated: a mean of two surfaces is none.

Shape symbols: H, W size of the color image; h, w size of the depth image.
"""

import numpy as np

from r3jax.formats.lenses import Lens
from r3jax.validation.errors import ForeignFileError


def resample_depth(depth: np.ndarray, lens: Lens, depth_lens: Lens | None = None) -> np.ndarray:
    """Samples z-depth at the nearest pixel of every ray of a color image, [H, W].

    Args:
        depth: [h, w].
        lens: the color image's; distortion does not count.
        depth_lens: pinhole of the depth image, at the same place and with the same axes; None: it
            covers what the color image covers.

    Returns:
        0 where the ray leaves the depth image.
    """
    fx, fy, cx, cy = lens.intrinsics
    if depth_lens is None:
        column, row = (
            ((np.arange(now) + 0.5) * there / now).astype(np.int64)
            for now, there in ((lens.width, depth.shape[1]), (lens.height, depth.shape[0]))
        )
        return depth[row[:, None], column[None, :]]
    fx_depth, fy_depth, cx_depth, cy_depth = depth_lens.intrinsics
    column = _along(lens.width, fx, cx, fx_depth, cx_depth)
    row = _along(lens.height, fy, cy, fy_depth, cy_depth)
    sampled = depth[
        row.clip(0, depth.shape[0] - 1)[:, None], column.clip(0, depth.shape[1] - 1)[None, :]
    ]
    is_row = (row >= 0) & (row < depth.shape[0])
    is_column = (column >= 0) & (column < depth.shape[1])
    return np.where(is_row[:, None] & is_column[None, :], sampled, np.float32(0.0))


def _along(
    count: int, focal: float, center: float, focal_depth: float, center_depth: float
) -> np.ndarray:
    """Pixels of the depth image along one axis, [count] int64; -1 and beyond: outside of it."""
    slope = (np.arange(count) + 0.5 - center) / focal
    return np.floor(focal_depth * slope + center_depth).clip(-1, 1 << 30).astype(np.int64)


def keep_confident(depth: np.ndarray, confidence: np.ndarray, best: int) -> np.ndarray:
    """Makes every depth no measurement whose confidence is below the best one.

    Args:
        depth: [h, w].
        confidence: of the same size.
        best: the sensor's highest level.

    Raises:
        ForeignFileError: the sizes differ.
    """
    if confidence.shape != depth.shape:
        raise ForeignFileError(
            f"the confidence has {confidence.shape[1]} x {confidence.shape[0]} pixels, its depth "
            f"image {depth.shape[1]} x {depth.shape[0]}"
        )
    return np.where(confidence >= best, depth, np.float32(0.0))


def register_depth(
    depth: np.ndarray, depth_lens: Lens, lens: Lens, T_color_depth: np.ndarray
) -> np.ndarray:
    """Moves the depth of one camera into the image of another beside it (forward warping).

    Every measurement becomes a point, which falls into one pixel; the nearest hides the others.
    The result is a little coarser than the depth, so that few of its pixels stay empty.

    Args:
        depth: z-depth [h, w] float32.
        depth_lens: pinhole of the depth camera.
        lens: pinhole of the color camera.
        T_color_depth: takes points of the depth camera to the color camera, [4, 4].

    Returns:
        z-depth [h', w'] float32 that covers what the color image covers; 0 where nothing fell.
    """
    fx, fy, cx, cy = depth_lens.intrinsics
    row, column = np.nonzero((depth > 0.0) & np.isfinite(depth))
    z = depth[row, column].astype(np.float64)
    local = np.stack([(column + 0.5 - cx) / fx * z, (row + 0.5 - cy) / fy * z, z], axis=1)
    x, y, z = (local @ T_color_depth[:3, :3].T + T_color_depth[:3, 3]).T
    fx_color, fy_color, cx_color, cy_color = lens.intrinsics
    coarser = 0.9 * min(1.0, fx / fx_color, fy / fy_color)
    height, width = (max(1, int(side * coarser)) for side in (lens.height, lens.width))
    z_or_far = np.where(z > 1e-3, z, np.inf)
    u = np.floor((fx_color * x / z_or_far + cx_color) * width / lens.width)
    v = np.floor((fy_color * y / z_or_far + cy_color) * height / lens.height)
    is_in = (z > 1e-3) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    nearest = np.full((height, width), np.inf)
    place = v[is_in].astype(np.int64), u[is_in].astype(np.int64)
    np.minimum.at(nearest, place, z[is_in])
    return np.where(np.isfinite(nearest), nearest, 0.0).astype(np.float32)
