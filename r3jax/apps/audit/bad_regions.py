"""Finds the places with the largest deficit: blocks of voxels that render badly, the worst first.

Shape symbols: N rows of the map; m bad voxels; X Y Z cells of the coarse grid.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from r3jax.apps.audit.diagnosis import CAUSES, FEWEST_PICTURES, FINE, NOT_KNOWN, Diagnosis
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid, centers_on_host
from r3jax.mapping.state import MapState
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.renderability import term_images

BLOCK = 1.0
"""Size of a region, and minimum distance between the centers of two [audit units]."""

MOST = 10
"""Maximum number of bad regions listed."""

MOST_UNSEEN = 6
"""Maximum number of unseen regions listed."""

_SMALLEST = 0.02
"""Smaller regions are not reported [square audit units]."""

_FACES = ndimage.generate_binary_structure(3, 1)


@dataclass(frozen=True)
class Region:
    """One bad place."""

    center: np.ndarray
    """Center of its bad voxels or cells, [3] [audit units]."""

    area: float
    """Area of its bad voxels or cells, counting one face of each [square audit units]."""

    cause: str
    """Most frequent cause among its bad voxels; `unseen` or `not_known` if it has no voxels yet."""

    renderability: float
    """Mean over its bad voxels; 0 where nothing is known."""

    bad_share: float
    """Share of bad voxels among the visible voxels of the block; 1 where nothing is known."""

    rows: np.ndarray
    """Rows of its bad voxels in the map; for `unseen`, flat indices of its cells; for `not_known`,
    empty."""

    @property
    def is_known(self) -> bool:
        """True if it has surfaces."""
        return self.cause not in ("unseen", NOT_KNOWN)


def bad_regions(state: MapState, diagnosis: Diagnosis, most: int = MOST) -> list[Region]:
    """Finds the known surfaces that would render badly, the largest deficit first.

    The loss of a block is the sum of 1 - R over its bad voxels. A region is what lies within half
    a block of the bad voxel in the middle of the worst block that is left.

    Args:
        state: the map.
        diagnosis: diagnosis of its voxels.
        most: maximum number of regions.
    """
    centers = np.asarray(state.center, np.float64).T
    face = float(state.voxel_size) ** 2
    left = diagnosis.is_seen & (diagnosis.value < FINE)
    found: list[Region] = []
    while len(found) < most and left.any():
        rows = np.flatnonzero(left)
        middle = _worst_block(centers[rows], 1.0 - diagnosis.value[rows])
        is_near = np.abs(centers - middle).max(axis=1) <= 0.5 * BLOCK
        bad = is_near & left
        area = float(bad.sum()) * face
        if area >= _SMALLEST:
            causes = np.bincount(diagnosis.cause[bad], minlength=len(CAUSES))
            region = Region(
                center=centers[bad].mean(axis=0),
                area=area,
                cause=CAUSES[int(np.argmax(causes))],
                renderability=float(diagnosis.value[bad].mean()),
                bad_share=float(bad.sum() / (is_near & diagnosis.is_seen).sum()),
                rows=np.flatnonzero(bad),
            )
            found.append(region)
        left &= ~is_near
    # A region differs slightly from the block in which it was found.
    return sorted(found, key=lambda region: -float((1.0 - diagnosis.value[region.rows]).sum()))


def _worst_block(points: np.ndarray, loss: np.ndarray) -> np.ndarray:
    """Returns the central point of the grid block with the largest total deficit, [3]."""
    index = np.floor(points / BLOCK).astype(np.int64)
    _, block = np.unique(index, axis=0, return_inverse=True)
    block = block.reshape(-1)
    worst = int(np.argmax(np.bincount(block, weights=loss)))
    inside = points[block == worst]
    # Choose one of the points, so that the center lies on a surface.
    return inside[np.argmin(np.linalg.norm(inside - inside.mean(axis=0), axis=1))]


def unseen_edges(grid: OccupancyGrid, open_cells: np.ndarray) -> np.ndarray:
    """Finds cells where known free space borders on unseen space, [X, Y, Z] bool.

    Args:
        grid: free and occupied space.
        open_cells: unexplored cells to consider, [X, Y, Z] bool; excludes the inside of walls.
    """
    return open_cells & ndimage.binary_dilation(np.asarray(grid.free), _FACES)


def unseen_regions(grid: OccupancyGrid, edges: np.ndarray, most: int = MOST_UNSEEN) -> list[Region]:
    """Finds the ends of a capture: blocks of unseen cells beside free space, the largest first.

    Args:
        grid: free and occupied space.
        edges: unseen cells beside free space, [X, Y, Z] bool.
        most: maximum number of regions.
    """
    cell = float(grid.cell_size)
    points = centers_on_host(grid, np.argwhere(edges))
    flat = np.flatnonzero(edges)
    left = np.ones(len(points), dtype=bool)
    found: list[Region] = []
    while len(found) < most and left.any():
        middle = _worst_block(points[left], np.ones(int(left.sum())))
        is_near = left & (np.abs(points - middle).max(axis=1) <= max(0.5 * BLOCK, cell))
        area = float(is_near.sum()) * cell * cell
        found.append(Region(points[is_near].mean(axis=0), area, "unseen", 0.0, 1.0, flat[is_near]))
        left &= ~is_near
    return found


def blank_points(
    state: MapState, known: np.ndarray, camera: Camera, pose: np.ndarray, config: ScoringConfig
) -> np.ndarray:
    """Estimates the points seen by pixels without a known surface, [k, 3] [audit units].

    Their depth is copied from the nearest pixel with a known surface. This is an estimate that
    works for a wall between its edges. An image without any known surface yields no points.

    Args:
        state: the map of all images.
        known: rows that are known surfaces, [N].
        camera: camera of the image.
        pose: `T_world_camera`, [4, 4] [audit units].
        config: range and size of the depth buffer.
    """
    row = np.asarray(term_images(state, camera, jnp.asarray(pose, jnp.float32), config).row)
    is_known = (row < state.capacity) & known[np.where(row < state.capacity, row, 0)]
    if not is_known.any():
        return np.zeros((0, 3))
    near = np.zeros((2, *row.shape), dtype=np.int32)
    ndimage.distance_transform_edt(
        ~is_known, return_distances=False, return_indices=True, indices=near
    )
    centers = np.asarray(state.center, np.float64).T
    depth = (centers[row[near[0], near[1]]] - pose[:3, 3]) @ pose[:3, 2]
    height, width = row.shape
    x = ((np.arange(width) + 0.5) * (camera.width / width) - float(camera.cx)) / float(camera.fx)
    y = ((np.arange(height) + 0.5) * (camera.height / height) - float(camera.cy)) / float(camera.fy)
    rays = np.stack([*np.meshgrid(x, y), np.ones_like(depth)], axis=-1)
    points = (depth[..., None] * rays) @ pose[:3, :3].T + pose[:3, 3]
    return points[~is_known]


def blank_regions(
    state: MapState, points: Sequence[np.ndarray], most: int = MOST_UNSEEN
) -> list[Region]:
    """Finds places that images show but where no surface is known, the largest first.

    Args:
        state: the map of all images, which provides the voxel size.
        points: `blank_points` of every image.
        most: maximum number of regions.
    """
    size = float(state.voxel_size)
    voxels = [np.unique(np.floor(part / size).astype(np.int64), axis=0) for part in points]
    if not sum(len(part) for part in voxels):
        return []
    found, count = np.unique(np.concatenate(voxels), axis=0, return_counts=True)
    taken = np.floor(np.asarray(state.center).T[np.asarray(state.present)] / size).astype(np.int64)
    blank = (found[count >= FEWEST_PICTURES] + 0.5) * size
    if len(taken) and len(blank):  # points beside a known surface do not count as unknown
        distance, _ = KDTree((taken + 0.5) * size).query(blank)
        blank = blank[np.asarray(distance) > 1.5 * size]
    left = np.ones(len(blank), dtype=bool)
    regions: list[Region] = []
    none = np.zeros(0, dtype=np.int64)
    while len(regions) < most and left.any():
        middle = _worst_block(blank[left], np.ones(int(left.sum())))
        is_near = left & (np.abs(blank - middle).max(axis=1) <= 0.5 * BLOCK)
        area = float(is_near.sum()) * size**2
        if area >= _SMALLEST:
            regions.append(Region(blank[is_near].mean(axis=0), area, NOT_KNOWN, 0.0, 1.0, none))
        left &= ~is_near
    return sorted(regions, key=lambda region: -region.area)
