"""Initializes the Gaussians from a thinned point cloud of the recorded depth.

NumPy on the host: it runs once, sizes are not known beforehand, and float64 costs nothing here.

Shape symbols: v views; H, W image size; m points; n Gaussians.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray
from scipy.spatial import KDTree

from r3jax.errors import InputError
from r3jax.geometry.cameras import Camera
from r3jax.kernels.constants import SH0
from r3jax.splatting.errors import ViewsError
from r3jax.splatting.scene import DEAD_LOGIT, GaussianScene
from r3jax.splatting.views import Views

INITIAL_OPACITY = 0.1
"""Opacity of every Gaussian at the beginning (Kerbl et al. 2023)."""

_MAX_POINTS = 4_000_000
"""Most pixels that are used, a regular part of more: 100k Gaussians still get 40 points each."""

_EDGE_STEP = 0.05
"""Neighboring depths that differ by a larger share lie on two sides of an edge."""

_STEEPEST = 8.0
"""Slope (83 deg from facing the camera) up to which a surface is no edge, in coarse images."""

_FINEST_VOXEL = 1e-3
"""Voxels are not made smaller than this [m]."""

_SCALE_LIMITS = (0.2, 5.0)
"""Scales stay within these multiples of their median, so that outliers do not become fog."""


def initialize(
    views: Views,
    num_gaussians: int = 100_000,
    capacity: int | None = None,
    sh_degree: int = 3,
    *,
    voxel_size: float | None = None,
    key: PRNGKeyArray | None = None,
) -> GaussianScene:
    """Places Gaussians on the surfaces that the views' depth shows.

    One Gaussian per occupied voxel, at the mean of the points in it and with their mean color;
    round, as large as the root mean square distance to its three neighbors (as Kerbl et al.
    2023 start from structure-from-motion points). The same input gives the same scene.

    Args:
        views: images with depth.
        num_gaussians: upper bound, nearly reached if the depth has that much detail.
        capacity: rows of the scene; the rest is unused. None: as many as Gaussians.
        sh_degree: degree of the harmonics, 0 to 3; all but the constant begin at 0.
        voxel_size: edge of the voxels [m]; `num_gaussians` is then ignored. None: chosen.
        key: if no view has depth, `num_gaussians` points are drawn with this key, evenly inside
            a box around what the cameras look at, in the views' mean color.

    Returns:
        The scene, used rows first.

    Raises:
        ViewsError: no view has depth and there is no key.
        ValueError: settings out of range, or more Gaussians than the capacity.
    """
    if num_gaussians < 1 or not 0 <= sh_degree <= 3:
        raise InputError(
            "num_gaussians must be at least 1 and sh_degree 0 to 3, got "
            f"{num_gaussians} and {sh_degree}"
        )
    if voxel_size is not None and not 0.0 < voxel_size < np.inf:
        raise InputError(f"voxel_size must be positive [m], got {voxel_size}")
    points, colors = surface_points(views)
    if len(points) == 0:
        if key is None:
            raise ViewsError(
                f"none of the {len(views)} views has a depth measurement to begin from: record "
                "depth, or pass a key to begin with random points"
            )
        points, colors = _random_points(views, num_gaussians, key)
    else:
        size = voxel_size or fitting_voxel_size(points, num_gaussians)
        points, colors = thin(points, colors, size)
    capacity = len(points) if capacity is None else capacity
    if len(points) > capacity:
        raise InputError(
            f"{len(points)} Gaussians do not fit in a capacity of {capacity}: ask for fewer, "
            "for larger voxels or for more capacity"
        )
    return _as_scene(points, colors, capacity, sh_degree)


def surface_points(views: Views) -> tuple[np.ndarray, np.ndarray]:
    """Computes points [m, 3] float64 [m] and colors [m, 3] float32 of the measured pixels.

    Pixels on depth edges, whose color mixes foreground and background, are left out (unless
    nothing else is there). Of very many pixels every second, third, ... row and column is used,
    another set in each view.
    """
    rgb, depth = np.asarray(views.rgb), np.asarray(views.depth)
    poses = np.asarray(views.T_world_camera, dtype=np.float64)
    stride = max(1, int(np.ceil(np.sqrt(depth.size / _MAX_POINTS))))
    measured = [np.isfinite(image) & (image > 0.0) for image in depth]
    cameras = [jax.tree.map(lambda x, i=i: x[i], views.cameras) for i in range(len(views))]
    keep = [
        m & ~_on_edge(image, camera)
        for m, image, camera in zip(measured, depth, cameras, strict=True)
    ]
    if not any(mask.any() for mask in keep):
        keep = measured
    points, colors = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.uint8)]
    for i, camera in enumerate(cameras):
        part = np.s_[i % stride :: stride, (i // stride) % stride :: stride]
        chosen = np.zeros_like(keep[i])
        chosen[part] = keep[i][part]
        points.append(_unproject(camera, poses[i], depth[i], chosen))
        colors.append(rgb[i][chosen])
    # Column by column in memory: all that follows works on one coordinate at a time.
    stacked = np.asfortranarray(np.concatenate(points))
    return stacked, np.concatenate(colors).astype(np.float32) / np.float32(255.0)


def _unproject(camera: Camera, pose: np.ndarray, depth: np.ndarray, chosen: np.ndarray):
    """Computes the world coordinates [m, 3] of the chosen pixels' centers."""
    row, column = np.nonzero(chosen)
    z = depth[row, column].astype(np.float64)
    x = (column + 0.5 - float(camera.cx)) / float(camera.fx) * z
    y = (row + 0.5 - float(camera.cy)) / float(camera.fy) * z
    return np.stack([x, y, z], axis=1) @ pose[:3, :3].T + pose[:3, 3]


def _on_edge(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """Finds pixels beside a step in depth, [H, W].

    Holes do not count as neighbors, pixels beyond the range do.
    """
    share = max(_EDGE_STEP, _STEEPEST / float(camera.focal))
    capped = np.minimum(depth, np.float32(1e6))  # differences stay finite
    on_edge = np.zeros(depth.shape, dtype=bool)
    for near, far in (
        (np.s_[:-1, :], np.s_[1:, :]),
        (np.s_[:, :-1], np.s_[:, 1:]),
    ):
        a, b = capped[near], capped[far]
        step = (np.abs(a - b) > share * np.minimum(a, b)) & (a > 0.0) & (b > 0.0)
        on_edge[near] |= step
        on_edge[far] |= step
    return on_edge


def fitting_voxel_size(points: np.ndarray, num_gaussians: int) -> float:
    """Finds the voxel size [m] at which nearly, but at most, `num_gaussians` are occupied.

    Surfaces occupy voxels by the inverse square of the edge: the search starts with that slope
    and goes on with the slope that it finds. No finer than a millimeter, nor than float32 can
    tell apart.
    """
    extent = float(np.ptp(points, axis=0).max())
    finest = max(_FINEST_VOXEL, extent * 2.0**-20)
    size, slope, before = max(finest, extent / 64.0), -2.0, None
    best, best_count = 1.001 * extent + finest, 1  # one voxel that holds everything
    for _ in range(10):
        count = _num_occupied(points, size)
        if best_count < count <= num_gaussians:
            best, best_count = size, count
        if count <= num_gaussians and (count >= 0.95 * num_gaussians or size == finest):
            return size
        if before is not None and before[0] != size:
            slope = np.log(count / before[1]) / np.log(size / before[0])
        before = (size, count)
        step = np.log(0.975 * num_gaussians / count) / np.clip(slope, -3.0, -0.3)
        size = max(finest, float(size * np.exp(step)))
    return best


def _voxel_keys(points: np.ndarray, voxel_size: float) -> np.ndarray:
    """Computes one number for all points in a voxel, [m] int64.

    Neighbors along z have consecutive numbers.
    """
    key = np.zeros(len(points), dtype=np.int64)
    num_cells = 1
    for axis in range(3):
        along = points[:, axis]
        index = ((along - along.min()) * (1.0 / voxel_size)).astype(np.int64)
        size = int(index.max()) + 1
        num_cells *= size
        if num_cells >= 1 << 62:
            raise InputError(
                f"voxels of {voxel_size:g} m are too small for points that span "
                f"{np.ptp(points, axis=0).max():g} m"
            )
        key = key * size + index
    return key


def _num_occupied(points: np.ndarray, voxel_size: float) -> int:
    keys = np.sort(_voxel_keys(points, voxel_size))
    return 1 + int(np.count_nonzero(keys[1:] != keys[:-1]))


def thin(
    points: np.ndarray, colors: np.ndarray, voxel_size: float
) -> tuple[np.ndarray, np.ndarray]:
    """Averages the points and the colors in each occupied voxel, [n, 3] float64 both.

    Args:
        points: [m, 3] [m], at least one.
        colors: [m, 3].
        voxel_size: edge [m].
    """
    _, voxel, count = np.unique(
        _voxel_keys(points, voxel_size), return_inverse=True, return_counts=True
    )

    def mean(values: np.ndarray) -> np.ndarray:
        sums = [np.bincount(voxel, weights=values[:, i]) for i in range(3)]
        return np.stack(sums, axis=1) / count[:, None]

    return mean(points), mean(colors)


def neighbor_scales(points: np.ndarray) -> np.ndarray:
    """Computes the root mean square distance to the 3 nearest points [m], within limits, [n].

    Points that coincide, and stray ones, are held within a fifth and five times the median. A
    single point gets 5 cm.
    """
    num_neighbors = min(3, len(points) - 1)
    if num_neighbors == 0:
        return np.full(len(points), 0.05)
    distance, _ = KDTree(points).query(points, k=num_neighbors + 1, workers=-1)
    scale = np.sqrt((distance[:, 1:] ** 2).mean(axis=1))
    typical = float(np.median(scale))
    return scale.clip(*(max(limit * typical, 1e-6) for limit in _SCALE_LIMITS))


def _random_points(views: Views, count: int, key: Array) -> tuple[np.ndarray, np.ndarray]:
    """Draws points evenly inside a box around the cameras and their targets.

    What they look at is taken to lie as far ahead as the cameras are apart, at least 1 m.
    """
    centers = np.asarray(views.T_world_camera[:, :3, 3], dtype=np.float64)
    axes = np.asarray(views.T_world_camera[:, :3, 2], dtype=np.float64)
    reach = max(float(np.linalg.norm(np.ptp(centers, axis=0))), 1.0)
    corners = np.concatenate([centers, centers + reach * axes])
    low, high = corners.min(axis=0) - 0.1 * reach, corners.max(axis=0) + 0.1 * reach
    points = low + (high - low) * np.asarray(jax.random.uniform(key, (count, 3)))
    color = np.asarray(views.rgb).mean(axis=(0, 1, 2)) / 255.0
    return points, np.broadcast_to(color, (count, 3))


def _as_scene(
    points: np.ndarray, colors: np.ndarray, capacity: int, sh_degree: int
) -> GaussianScene:
    """Makes round Gaussians of one opacity, and unused rows after them."""
    n = len(points)
    log_scales = np.zeros((capacity, 3), dtype=np.float32)
    log_scales[:n] = np.log(neighbor_scales(points))[:, None]
    means = np.zeros((capacity, 3), dtype=np.float32)
    means[:n] = points
    logits = np.full(capacity, DEAD_LOGIT, dtype=np.float32)
    logits[:n] = np.log(INITIAL_OPACITY / (1.0 - INITIAL_OPACITY))
    sh = np.zeros((capacity, (sh_degree + 1) ** 2, 3), dtype=np.float32)
    sh[:n, 0] = (colors - 0.5) / SH0
    return GaussianScene(
        means=jnp.asarray(means),
        quats=jnp.zeros((capacity, 4)).at[:, 0].set(1.0),
        log_scales=jnp.asarray(log_scales),
        opacity_logits=jnp.asarray(logits),
        sh=jnp.asarray(sh),
    )
