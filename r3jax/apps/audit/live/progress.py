"""What is done of a scan, in numbers and from above, fast enough for every frame.

Shape symbols: N rows of the map; h, w image size; k places.
"""

from dataclasses import dataclass

import numpy as np
from matplotlib import colormaps

from r3jax.apps.audit.diagnosis import FINE
from r3jax.geometry.cameras import Camera
from r3jax.mapping.state import MapState
from r3jax.planning.planner import Planner
from r3jax.plots import style
from r3jax.plots.pictures import floor_picture
from r3jax.scoring.renderability import voxel_renderability

_PLACES = 6
"""Places where the camera was, spread over its path, from which surfaces are evaluated."""

_HEADROOM = 0.35
"""As in `floor_picture` [m]."""

_FARTHEST = 5.0
"""What is farther from a place is not asked of it [m]."""

_MARGIN = 0.6
"""Shown round what is known [m]."""

_COLORED = 0.75
"""How much of the color of a surface on the plan is that of its renderability."""


@dataclass(frozen=True)
class ScanProgress:
    """What is done."""

    fine_share: float
    """Share of the surfaces seen so far that would render well from where the camera was."""

    area: float
    """Area of the surfaces seen so far, a voxel's face each [square meters]."""

    plan: np.ndarray
    """The place from above, surfaces from red to green, [h, w, 3] uint8; row 0 at the largest y."""

    extent: tuple[float, float, float, float]
    """Left, right, bottom and top of the plan [m]."""


def scan_progress(planner: Planner, camera: Camera, places: np.ndarray) -> ScanProgress:
    """Evaluates what was seen.

    Args:
        planner: map and grid.
        camera: would render.
        places: where the camera was, [k, 3], k >= 1.
    """
    state = planner.map_state
    value = mean_value(state, camera, places)
    is_seen = np.isfinite(value)
    share = float((value[is_seen] >= FINE).mean()) if is_seen.any() else 0.0
    area = float(is_seen.sum()) * float(state.voxel_size) ** 2
    plan, extent = _plan(planner, value, places)
    return ScanProgress(share, area, plan, extent)


def mean_value(state: MapState, camera: Camera, places: np.ndarray) -> np.ndarray:
    """Mean renderability of every voxel from some of the places within 5 m of it, [N]; NaN: none.

    Whether something stands between is not asked: that would take a depth buffer for each place.
    """
    spread = np.unique(np.linspace(0, len(places) - 1, _PLACES).round().astype(int))
    center = np.asarray(state.center, np.float32).T
    total, count = np.zeros(len(center)), np.zeros(len(center))
    for place in places[spread].astype(np.float32):
        near = np.sum((center - place) ** 2, axis=1) < _FARTHEST**2
        total += near * np.asarray(voxel_renderability(state, place, camera.focal).value)
        count += near
    known = np.asarray(state.occupied) & (count > 0)
    return np.where(known, total / np.maximum(count, 1), np.nan)


def _plan(
    planner: Planner, value: np.ndarray, places: np.ndarray
) -> tuple[np.ndarray, tuple[float, float, float, float]]:
    """The place from above, cut to what is known; and its extent."""
    height = float(np.median(places[:, 2]))
    picture, (left, right, bottom, _) = floor_picture(planner.map_state, planner.grid, height)
    pixel = (right - left) / picture.shape[1]
    center = np.asarray(planner.map_state.center, np.float64).T
    shown = np.isfinite(value) & (center[:, 2] < height + _HEADROOM)
    order = np.flatnonzero(shown)[np.argsort(center[shown, 2], kind="stable")]
    column, row = np.floor((center[order, :2] - [left, bottom]) / pixel).astype(int).T
    inside = (column >= 0) & (column < picture.shape[1]) & (row >= 0) & (row < picture.shape[0])
    column, row, order = column[inside], row[inside], order[inside]
    colors = colormaps[style.SCORE_MAP](value[order])[:, :3]
    picture[row, column] = _COLORED * colors + (1.0 - _COLORED) * picture[row, column]
    known = np.concatenate([center[shown, :2], places[:, :2]])
    low, high = known.min(axis=0) - _MARGIN, known.max(axis=0) + _MARGIN
    x0, y0 = np.maximum(np.floor((low - [left, bottom]) / pixel), 0).astype(int)
    x1, y1 = np.ceil((high - [left, bottom]) / pixel).astype(int)
    cut = picture[y0:y1, x0:x1]
    extent = (left + x0 * pixel, left + (x0 + cut.shape[1]) * pixel,
              bottom + y0 * pixel, bottom + (y0 + cut.shape[0]) * pixel)  # fmt: skip
    return np.rint(255.0 * cut[::-1]).clip(0, 255).astype(np.uint8), extent
