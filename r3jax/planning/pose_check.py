"""Tests whether the poses of the first frames agree with their depth, to detect wrong conventions.

A world-to-camera matrix and a pose in OpenGL axes are rigid, too, so that a single frame does not
show the mistake. Between two frames, each convention implies a different motion of the camera. The
points of each frame are projected into the other by that motion: a point in front of the surface
measured there contradicts it, because the other frame saw through that space. The convention
without such points is the right one. On the host in NumPy, about 2 ms per frame, until one pair of
frames is conclusive.

Shape symbols: h w pixels of a subsampled depth image; n points.
"""

import math
import warnings
from dataclasses import replace

import equinox as eqx
import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from r3jax.frame import CONVENTIONS, Frame, to_camera_to_world

_SIDE = 64
"""Approximate number of columns of a subsampled depth image."""

_TOLERANCE = 0.05
"""Depths agree up to this [m], and up to this share of the depth."""

_MIN_OVERLAP = 0.15
"""Minimum share of points with a measurement in the other frame for a conclusion."""

_MIN_POINTS = 200
"""Minimum number of measured points of a frame for a conclusion."""

_MAX_CONTRADICTED = 0.4
"""Two frames disagree from this share of contradicted points on."""

_MAX_OF_FITTING = 0.25
"""Another convention fits up to this share of contradicted points."""

_SUSPECTED = 3
"""Pairs in a row before another convention is suggested: walls of two rooms may fit by chance."""

_UPRIGHT = 0.5
"""From this cosine on between the image's downward axis and the world's, a camera is upright."""

_MAX_FRAMES = 200
"""Number of frames after which the test is given up: a camera that hardly moves is never
conclusive."""


class Reference(eqx.Module):
    """An earlier frame, subsampled, for comparison with the next ones."""

    depth: np.ndarray
    """z-depth, 0 where it is not known, [h, w] float32 [m]."""

    T_world_camera: np.ndarray
    """Its pose, [4, 4] float64."""

    intrinsics: np.ndarray
    """fx, fy, cx, cy of the subsampled image, whose pixel centers are whole numbers [px]."""

    num_compared: int = 0
    """Number of frames compared so far."""

    suspect: str = ""
    """Another convention with which frames overlap that do not overlap as given."""

    num_suspected: int = 0
    """Number of pairs in a row that suggest `suspect`."""

    is_settled: bool = False
    """True once the test is finished."""


def check_poses(reference: Reference | None, frame: Frame) -> Reference:
    """Compares a frame with an earlier one, and warns if their poses contradict their depth.

    Args:
        reference: the earlier frame; None: this is the first one.
        frame: the observed frame.

    Returns:
        The reference for the next frame.
    """
    if reference is None:
        return reference_of(frame)
    if reference.is_settled:
        return reference
    num = reference.num_compared + 1
    now = replace(reference_of(frame), num_compared=num, is_settled=num >= _MAX_FRAMES)
    shares = {name: contradicted(reference, now, name) for name in CONVENTIONS}
    given = shares.pop("opencv")
    fitting = min(shares, key=lambda name: shares[name] if shares[name] >= 0.0 else math.inf)
    fits = shares[fitting] <= _MAX_OF_FITTING
    if given > _MAX_CONTRADICTED:
        _warn(
            f"{given:.0%} of the points of two frames lie where the other saw through",
            fitting,
            fits,
        )
        return replace(reference, is_settled=True)
    if math.isnan(given):
        # The frames do not overlap as given. That they do with another convention may be chance,
        # but not repeatedly; "ros" turns a sideways rotation into a roll, with which any two walls
        # fit.
        suspect = reference.suspect
        if suspect and shares[suspect] > _MAX_OF_FITTING:
            # Frames in their true convention never contradict, so the earlier fit was chance.
            return replace(now, suspect="", num_suspected=0)
        # A robot's views lie meters apart, and in one pair of ten its walls fit backwards, too. Its
        # camera is upright, which it would not be if its convention were another one.
        if not fits or fitting == "ros" or _is_upright(now.T_world_camera, "opencv"):
            return replace(now, suspect=suspect, num_suspected=reference.num_suspected)
        pairs = reference.num_suspected + 1 if fitting == reference.suspect else 1
        if pairs >= _SUSPECTED or _is_upright(now.T_world_camera, fitting):
            _warn("frames overlap that should not", fitting, fits)
            return replace(now, is_settled=True)
        return replace(now, suspect=fitting, num_suspected=pairs)
    if not _is_upright(now.T_world_camera, "opencv") and any(
        _is_upright(now.T_world_camera, name) for name in shares
    ):
        # Upside down, or rolled: that these two frames fit may be chance.
        return replace(now, suspect=reference.suspect, num_suspected=reference.num_suspected)
    # Finished once every other convention would have been detected in the same pair.
    if all(not share <= _MAX_CONTRADICTED for share in shares.values()):
        return replace(reference, is_settled=True)
    # The frames fit as given, so what suggested another convention was chance.
    return replace(
        reference, num_compared=num, is_settled=now.is_settled, suspect="", num_suspected=0
    )


def _is_upright(T_world_camera: np.ndarray, convention: str) -> bool:
    return bool(-to_camera_to_world(T_world_camera, convention)[2, 1] >= _UPRIGHT)


def _warn(finding: str, fitting: str, fits: bool) -> None:
    known = ", ".join(CONVENTIONS)
    advice = (
        f'convention="{fitting}" of Frame.from_arrays fits them, or was given without need'
        if fits
        else f"is their convention right (one of {known}), and the unit of the depth?"
    )
    text = f"the poses contradict the depth: {finding}; {advice}"
    warnings.warn(text, UserWarning, stacklevel=5)


def reference_of(frame: Frame) -> Reference:
    """Subsamples a frame's depth."""
    depth, camera = np.asarray(frame.depth), frame.camera
    step = max(1, round(camera.width / _SIDE))
    depth = depth[step // 2 :: step, step // 2 :: step]
    # inf only means that nothing is near: such pixels are ignored.
    depth = np.where(np.isfinite(depth), depth, 0.0).astype(np.float32)
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float64)
    lens[2:] -= step // 2 + 0.5
    return Reference(depth, np.asarray(frame.T_world_camera, np.float64), lens / step)


def contradicted(first: Reference, second: Reference, convention: str) -> float:
    """Returns the share of points of two frames that lie in space the other frame saw through.

    Args:
        first: a frame.
        second: another one.
        convention: the convention of their poses.

    Returns:
        Share of the points that lie where the other frame has a measurement, and not behind it; NaN
        if there are too few of them.
    """
    A, B = (to_camera_to_world(one.T_world_camera, convention) for one in (first, second))
    T = np.linalg.inv(A) @ B
    pairs = ((second, first, T), (first, second, np.linalg.inv(T)))
    counts = np.array([_count(source, target, motion) for source, target, motion in pairs])
    num_points, agreeing, opposed = counts.sum(axis=0)
    is_known = num_points >= _MIN_POINTS and agreeing + opposed >= _MIN_OVERLAP * num_points
    return float(opposed / (agreeing + opposed)) if is_known else math.nan


def _count(source: Reference, target: Reference, T: np.ndarray) -> tuple[int, int, int]:
    """Counts a frame's points: all, those on the other's surface, and those in front of it."""
    fx, fy, cx, cy = source.intrinsics
    row, column = np.nonzero(source.depth)
    z = source.depth[row, column].astype(np.float64)
    points = np.stack([(column - cx) / fx * z, (row - cy) / fy * z, z])
    x, y, z = T[:3, :3] @ points + T[:3, 3:]
    fx, fy, cx, cy = target.intrinsics
    is_ahead = z > 0.1
    z = np.where(is_ahead, z, 1.0)
    u, v = np.rint(fx * x / z + cx), np.rint(fy * y / z + cy)
    height, width = target.depth.shape
    is_in = is_ahead & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    at = v[is_in].astype(int), u[is_in].astype(int)
    # On slopes and edges the depth changes within a sample: neighboring depths count, too.
    is_known = target.depth > 0.0
    near = minimum_filter(np.where(is_known, target.depth, np.inf), 3)[at]
    far = maximum_filter(target.depth, 3)[at]
    z, known = z[is_in], is_known[at]
    slack = _TOLERANCE * (1.0 + z)
    opposed = known & (z < near - slack)
    agreeing = known & ~opposed & (z <= far + slack)
    return len(points[0]), int(agreeing.sum()), int(opposed.sum())
