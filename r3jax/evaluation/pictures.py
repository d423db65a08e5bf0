"""Pictures computed from a map: the floor from above, and everything round a position.

Shape symbols: N rows of the map; X Y Z cells; h w picture size.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.renderability import score_voxels
from r3jax.scoring.visibility import panorama_buffer, place_panorama
from r3jax.scoring.voxels import voxels_of

_UNKNOWN = (0.86, 0.87, 0.89)
_FREE = (0.985, 0.985, 0.985)
_OCCUPIED = (0.68, 0.71, 0.76)
_HEADROOM = 0.35
"""The floor picture shows what lies below the cameras' height plus this [m]."""


def floor_picture(
    map_state: MapState, grid: OccupancyGrid, height: float
) -> tuple[np.ndarray, tuple[float, float, float, float]]:
    """The place from above, cut open over the cameras' heads.

    Light grey is unexplored at the cameras' height, white is free, dark grey is occupied; on
    top lie the highest voxels below the cut, in their mean colour.

    Args:
        map_state: the voxels.
        grid: free and unexplored space.
        height: typical height of the cameras [m].

    Returns:
        The picture [h, w, 3] in [0, 1], row 0 at the lowest y, and its extent in metres
        (left, right, bottom, top).
    """
    origin, cell = np.asarray(grid.origin, np.float64), float(grid.cell_size)
    shape = np.asarray(grid.log_odds.shape)
    layer = int(np.clip((height - origin[2]) / cell, 0, shape[2] - 1))
    voxel = float(map_state.voxel_size)
    scale = max(1, round(cell / voxel))
    picture = np.full((*shape[:2], 3), _UNKNOWN)
    picture[np.asarray(grid.free)[:, :, layer]] = _FREE
    picture[np.asarray(grid.occupied)[:, :, layer]] = _OCCUPIED
    picture = picture.repeat(scale, axis=0).repeat(scale, axis=1)  # [x, y, 3]

    present = np.asarray(map_state.occupied)
    centers = np.asarray(voxels_of(map_state).center)[:, present]
    colors = np.asarray(map_state.mean)[:, present].T
    below = centers[2] < height + _HEADROOM
    order = np.argsort(centers[2][below], kind="stable")  # the highest is painted last
    centers, colors = centers[:, below][:, order], colors[below][order]
    pixel = np.floor((centers[:2] - origin[:2, None]) / (cell / scale)).astype(int)
    inside = np.all((pixel >= 0) & (pixel < np.array(picture.shape[:2])[:, None]), axis=0)
    picture[pixel[0, inside], pixel[1, inside]] = colors[inside]
    left, bottom = origin[:2]
    right, top = origin[:2] + shape[:2] * cell
    return picture.transpose(1, 0, 2), (float(left), float(right), float(bottom), float(top))


@dataclass(frozen=True)
class PanoramaPicture:
    """An equirectangular picture round a position; the middle column looks along +x."""

    rgb: np.ndarray
    """Mean colour of the voxel seen, [h, w, 3]; light grey where there is none."""

    value: np.ndarray
    """Renderability of the voxel seen, [h, w]; NaN where there is none."""

    azimuth: float
    """Of the camera's axis in this position [rad]."""

    elevation: float
    """Of the camera's axis in this position [rad]."""


def panorama_picture(
    map_state: MapState, camera: Camera, T_world_camera: np.ndarray, max_range: float
) -> PanoramaPicture:
    """Renderability in all directions from a camera's position.

    Args:
        map_state: the voxels.
        camera: its focal length sets the resolution that is asked for.
        T_world_camera: the pose, [4, 4].
        max_range: range of the sensor [m].
    """
    position = jnp.asarray(T_world_camera[:3, 3], dtype=jnp.float32)
    config = ScoringConfig(max_range=jnp.asarray(max_range, jnp.float32))
    voxels = voxels_of(map_state)
    buffer = jax.jit(panorama_buffer)(voxels, position, config)
    value = np.asarray(jax.jit(score_voxels)(voxels, position, camera.focal).value)
    directions = _equirectangular(256, 512)
    place = place_panorama(
        jnp.asarray(directions.reshape(-1, 3).T) + position[:, None],
        jnp.ones(256 * 512, dtype=bool),
        position,
        config.panorama_size,
        config.max_range,
    )
    limit = config.panorama_size - 1
    row = np.clip(np.asarray(place.row).astype(int), 0, limit).reshape(256, 512)
    column = np.clip(np.asarray(place.column).astype(int), 0, limit).reshape(256, 512)
    item = np.asarray(buffer.item)[row, column]
    is_seen = item < map_state.capacity
    item = np.where(is_seen, item, 0)
    rgb = np.where(is_seen[..., None], np.asarray(map_state.mean).T[item], np.asarray(_UNKNOWN))
    forward = T_world_camera[:3, 2]
    return PanoramaPicture(
        rgb=rgb,
        value=np.where(is_seen, value[item], np.nan),
        azimuth=float(np.arctan2(forward[1], forward[0])),
        elevation=float(np.arcsin(np.clip(forward[2], -1.0, 1.0))),
    )


def _equirectangular(height: int, width: int) -> np.ndarray:
    """Unit directions of the pixel centers, [h, w, 3] float32: left is azimuth +180 degrees."""
    azimuth = np.pi * (1.0 - 2.0 * (np.arange(width) + 0.5) / width)
    elevation = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    level = np.cos(elevation)[:, None]
    x, y = level * np.cos(azimuth), level * np.sin(azimuth)
    z = np.broadcast_to(np.sin(elevation)[:, None], x.shape)
    return np.stack([x, y, z], axis=-1).astype(np.float32)
