"""Images of a map: the floor from above, and everything round a position; thumbnails for pages.

Shape symbols: N rows of the map; h w image size.
"""

import io
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Patch
from PIL import Image

from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.plots import style
from r3jax.scoring.renderability import voxel_renderability

_UNKNOWN = (0.86, 0.87, 0.89)
_FREE = (0.985, 0.985, 0.985)
_OCCUPIED = (0.68, 0.71, 0.76)
BEYOND = (0.78, 0.85, 0.94)
"""Color of directions that are free up to the sensor's range."""

_HEIGHT, _WIDTH = 256, 512
"""Size of a panorama image [px]."""

_LARGEST = 2048
"""Width and height of a floor image at most, unless the grid itself has more cells [px]."""

_HEADROOM = 0.35
"""The floor image shows what lies below the cameras' height plus this [m]."""


def floor_picture(
    map_state: MapState, grid: OccupancyGrid, height: float
) -> tuple[np.ndarray, tuple[float, float, float, float]]:
    """Draws the place from above, cut open above the cameras.

    Light gray is unexplored at the cameras' height, white is free, dark gray is occupied; on
    top lie the highest voxels below the cut, in their mean color.

    Args:
        map_state: the voxels.
        grid: free and unexplored space.
        height: typical height of the cameras [m].

    Returns:
        The image [h, w, 3] in [0, 1], row 0 at the lowest y, and its extent in meters
        (left, right, bottom, top).
    """
    origin, cell = np.asarray(grid.origin, np.float64), float(grid.cell_size)
    shape = np.asarray(grid.log_odds.shape)
    layer = int(np.clip((height - origin[2]) / cell, 0, shape[2] - 1))
    voxel = float(map_state.voxel_size)
    # A pixel shows a voxel, unless the cells are so much larger that one could not be seen.
    scale = max(1, min(round(cell / voxel), _LARGEST // int(shape[:2].max())))
    picture = np.full((*shape[:2], 3), _UNKNOWN)
    picture[np.asarray(grid.free)[:, :, layer]] = _FREE
    picture[np.asarray(grid.occupied)[:, :, layer]] = _OCCUPIED
    picture = picture.repeat(scale, axis=0).repeat(scale, axis=1)  # [x, y, 3]

    present = np.asarray(map_state.present)
    centers = np.asarray(map_state.center)[:, present]
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
    """An equirectangular image round a position; the middle column looks along +x."""

    rgb: np.ndarray
    """Mean color of the voxel seen, [h, w, 3]; blue or gray where there is none."""

    value: np.ndarray
    """Renderability of the voxel seen, [h, w]; NaN where there is none."""

    beyond: np.ndarray
    """True where free space is known up to the sensor's range, [h, w]; where there is neither a
    voxel nor this, the direction meets unexplored space."""

    azimuth: float
    """Azimuth of the camera's axis in this position [rad]."""

    elevation: float
    """Elevation of the camera's axis in this position [rad]."""


def panorama_picture(
    map_state: MapState,
    grid: OccupancyGrid,
    camera: Camera,
    T_world_camera: np.ndarray,
    max_range: float,
) -> PanoramaPicture:
    """Computes the renderability in all directions from a camera's position.

    Args:
        map_state: the voxels.
        grid: free and unexplored space.
        camera: its focal length sets the target resolution.
        T_world_camera: the pose, [4, 4].
        max_range: range of the sensor [m].
    """
    position = jnp.asarray(T_world_camera[:3, 3], dtype=jnp.float32)
    value = np.asarray(voxel_renderability(map_state, position, camera.focal).value)
    row = _nearest_rows(map_state, np.asarray(position), max_range)
    is_seen = row < map_state.capacity
    row = np.where(is_seen, row, 0)
    beyond = ~is_seen & _is_free_to(grid, np.asarray(position), max_range)
    empty = np.where(beyond[..., None], np.asarray(BEYOND), np.asarray(_UNKNOWN))
    rgb = np.where(is_seen[..., None], np.asarray(map_state.mean).T[row], empty)
    forward = T_world_camera[:3, 2]
    return PanoramaPicture(
        rgb=rgb,
        value=np.where(is_seen, value[row], np.nan),
        beyond=beyond,
        azimuth=float(np.arctan2(forward[1], forward[0])),
        elevation=float(np.arcsin(np.clip(forward[2], -1.0, 1.0))),
    )


def _is_free_to(grid: OccupancyGrid, position: np.ndarray, max_range: float) -> np.ndarray:
    """True where a straight line up to `max_range` [m] crosses known free cells alone, [h, w].

    Marches in half cells; what leaves the grid counts as unexplored, but for the last cell.
    """
    free, cell = np.asarray(grid.free), float(grid.cell_size)
    origin = np.asarray(grid.origin, np.float64)
    elevation = (0.5 - (np.arange(_HEIGHT) + 0.5) / _HEIGHT)[:, None] * np.pi
    azimuth = (0.5 - (np.arange(_WIDTH) + 0.5) / _WIDTH)[None, :] * 2.0 * np.pi
    flat = np.cos(elevation)
    direction = np.stack(
        np.broadcast_arrays(flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)), -1
    )
    is_free = np.ones(direction.shape[:2], bool)
    for distance in np.arange(0.5 * cell, max_range - cell, 0.5 * cell):
        index = np.floor((position + distance * direction - origin) / cell).astype(int)
        inside = np.all((index >= 0) & (index < free.shape), axis=-1)
        x, y, z = np.moveaxis(np.where(inside[..., None], index, 0), -1, 0)
        is_free &= inside & free[x, y, z]
    return is_free


def _nearest_rows(map_state: MapState, position: np.ndarray, max_range: float) -> np.ndarray:
    """Finds the map row that is seen in every direction, [h, w]; N where there is none.

    A painter's picture: every voxel covers the angle of its edge, the far ones are painted
    first. The first column looks along azimuth +180 degrees, the first row straight up.
    """
    offset = np.asarray(map_state.center).T - position
    distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-6)
    rows = np.flatnonzero(np.asarray(map_state.present) & (distance <= max_range))
    rows = rows[np.argsort(-distance[rows], kind="stable")]
    offset, distance = offset[rows], distance[rows]
    elevation = np.arcsin(offset[:, 2] / distance)
    azimuth = np.arctan2(offset[:, 1], offset[:, 0])
    # Half the angle of a voxel seen corner on, so that walls have no gaps; wider near the poles.
    half = np.arctan(0.75 * float(map_state.voxel_size) / distance)
    half_wide = np.minimum(half / np.maximum(np.cos(elevation), 1e-3), np.pi)
    pixel = np.pi / _HEIGHT
    top = np.clip((0.5 * np.pi - elevation - half) / pixel, 0, _HEIGHT).astype(int)
    bottom = np.ceil((0.5 * np.pi - elevation + half) / pixel).astype(int)
    left = np.floor((np.pi - azimuth - half_wide) / pixel).astype(int)
    right = np.ceil((np.pi - azimuth + half_wide) / pixel).astype(int)
    picture = np.full((_HEIGHT, _WIDTH), map_state.capacity)
    for row, y0, y1, x0, x1 in zip(rows, top, bottom, left, right, strict=True):
        picture[y0:y1, max(x0, 0) : x1] = row
        if x0 < 0:  # the image closes on itself
            picture[y0:y1, x0:] = row
        if x1 > _WIDTH:
            picture[y0:y1, : x1 - _WIDTH] = row
    return picture


_NEVER_SEEN = "#9ca3af"
"""Color of directions that meet unexplored space."""


def panorama_figure(picture: PanoramaPicture) -> Figure:
    """Draws all directions from one position: the mapped colors, and the renderability."""
    figure = style.new_figure(10.0, 9.6)
    upper, lower = figure.subplots(2, 1)
    extent = (180.0, -180.0, -90.0, 90.0)
    for axes, title in (
        (upper, "Mean color of the voxels seen"),
        (lower, "Renderability R of the voxels seen"),
    ):
        style.dress(axes, title, "azimuth [°]", "elevation [°]").grid(visible=False)
        axes.set_xticks(range(-180, 181, 60))
        axes.set_yticks(range(-90, 91, 45))
    upper.imshow(picture.rgb, extent=extent)
    image = show_renderability(lower, picture, extent)
    style.color_bar(figure, image, [upper, lower], "renderability R", shrink=0.4, anchor=(0.0, 0.0))
    lower.legend(
        handles=empty_directions(), fontsize=8, frameon=False, ncols=2,
        loc="upper right", bbox_to_anchor=(1.0, -0.1),
    )  # fmt: skip
    for axes in (upper, lower):
        axes.plot(
            np.rad2deg(picture.azimuth),
            np.rad2deg(picture.elevation),
            marker="+",
            markersize=14,
            markeredgewidth=2.0,
            color="white" if axes is upper else style.INK,
        )
    return figure


def show_renderability(
    axes: Axes, picture: PanoramaPicture, extent: tuple[float, float, float, float] | None = None
) -> AxesImage:
    """Draws R in all directions, and the two kinds of directions without a voxel apart."""
    axes.set_facecolor(_NEVER_SEEN)
    blue = np.concatenate([np.broadcast_to(BEYOND, (*picture.beyond.shape, 3)),
                           picture.beyond[..., None]], axis=-1)  # fmt: skip
    axes.imshow(blue, extent=extent)
    return axes.imshow(picture.value, extent=extent, cmap=style.SCORE_MAP, vmin=0.0, vmax=1.0)


def empty_directions() -> list[Patch]:
    """Makes the legend's entries for directions without a voxel."""
    kinds = (("beyond the sensor's range", BEYOND), ("never seen", _NEVER_SEEN))
    return [Patch(facecolor=color, edgecolor=style.MUTED, label=name) for name, color in kinds]


def small_png(rgb: np.ndarray, pose: np.ndarray, up: np.ndarray, side: int) -> bytes:
    """Makes a small PNG of an image, turned by quarters until the vertical points up.

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
    """Encodes an image [H, W, 3] uint8 as PNG."""
    buffer = io.BytesIO()
    Image.fromarray(rgb).save(buffer, format="png", compress_level=1)
    return buffer.getvalue()
