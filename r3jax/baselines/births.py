"""Where a frame gives birth to Gaussians, and rows that are added or dropped. On the host."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from r3jax.baselines.active_gs.normals import pixel_normals
from r3jax.baselines.settings import MapSettings
from r3jax.geometry.cameras import Camera
from r3jax.splatting.scene import DEAD_LOGIT, GaussianScene

_THICKNESS = 1e-5
"""Standard deviation of a disc across its plane [m]; it must not be 0."""

_FACING = -0.01
"""Cosine between ray and normal above which a surface is seen edge-on."""

_EDGE = 0.05
"""A step of depth up to this is no edge, for normals [m]."""

_normals = jax.jit(pixel_normals)


@dataclass(frozen=True)
class Born:
    """New Gaussians."""

    means: np.ndarray
    """Centers [b, 3] [m]."""

    quats: np.ndarray
    """Rotations, wxyz [b, 4]."""

    log_scales: np.ndarray
    """Logarithms of the standard deviations [b, 3]."""

    colors: np.ndarray
    """RGB in [0, 1] [b, 3]."""


def born_in(
    rgb: np.ndarray,
    depth: np.ndarray,
    pose: np.ndarray,
    camera: Camera,
    seen: tuple[np.ndarray, np.ndarray, np.ndarray],
    settings: MapSettings,
    rng: np.random.Generator,
) -> Born:
    """Finds the pixels that the map renders wrongly; one Gaussian per voxel of the spacing.

    Args:
        rgb: the frame's color in steps of 1/255, [h, w, 3].
        depth: its depth, 0 where there is none, [h, w] [m].
        pose: its T_world_camera.
        camera: its intrinsics.
        seen: color, depth and opacity that the map renders there, composited on black.
        settings: thresholds, spacing and size.
        rng: which pixel of a voxel is taken.
    """
    rgb = rgb.astype(np.float32) / 255.0
    is_valid = depth > 0.0
    normals = np.asarray(
        _normals(camera, jnp.asarray(depth), jnp.asarray(is_valid), jnp.float32(_EDGE))
    ).T
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    rays = _rays(camera)
    cosine = np.sum(normals * rays, axis=1) / np.linalg.norm(rays, axis=1)
    wanted = is_wrong(rgb, depth, seen, settings).ravel() & is_valid.ravel() & (cosine < _FACING)
    points = (rays * depth.reshape(-1, 1)) @ pose[:3, :3].T + pose[:3, 3]
    chosen = one_per_voxel(points, np.flatnonzero(wanted), settings.spacing, rng)
    size = np.full((len(chosen), 3), np.log(settings.size))
    if settings.flat:
        size[:, 2] = np.log(_THICKNESS)
    return Born(
        means=points[chosen].astype(np.float32),
        quats=turned_to(normals[chosen] @ pose[:3, :3].T).astype(np.float32),
        log_scales=size.astype(np.float32),
        colors=rgb.reshape(-1, 3)[chosen],
    )


def is_wrong(
    rgb: np.ndarray,
    depth: np.ndarray,
    seen: tuple[np.ndarray, np.ndarray, np.ndarray],
    settings: MapSettings,
) -> np.ndarray:
    """Pixels of the wrong color, too little opacity, or a surface in front of the map's."""
    color, distance, alpha = seen
    error = np.mean((color - rgb) ** 2, axis=-1)
    return (
        (error > settings.birth_color)
        | (alpha < settings.birth_opacity)
        | (depth - distance < -settings.birth_depth * depth)
    )


def one_per_voxel(
    points: np.ndarray, index: np.ndarray, spacing: float, rng: np.random.Generator
) -> np.ndarray:
    """Draws one of the points [p, 3] at `index` for each voxel that holds any, in their order."""
    shuffled = rng.permutation(index)
    voxel = np.floor(points[shuffled] / spacing).astype(np.int64)
    _, first = np.unique(voxel, axis=0, return_index=True)
    return np.sort(shuffled[first])


def turned_to(normals: np.ndarray) -> np.ndarray:
    """Quaternions wxyz that turn the z axis to unit vectors [b, 3], along the shortest arc."""
    x, y, z = normals.T
    quats = np.stack([1.0 + z, -y, x, np.zeros_like(x)], axis=1)
    # Straight down there is no shortest arc: half a turn about x.
    quats[z < -0.999999] = (0.0, 1.0, 0.0, 0.0)
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def _rays(camera: Camera) -> np.ndarray:
    """Rays (u, v, 1) of all pixels, row by row, [h w, 3]."""
    fx, fy, cx, cy = (float(x) for x in (camera.fx, camera.fy, camera.cx, camera.cy))
    u = (np.arange(camera.width) + 0.5 - cx) / fx
    v = (np.arange(camera.height) + 0.5 - cy) / fy
    columns, rows = np.meshgrid(u, v)
    return np.stack([columns, rows, np.ones_like(columns)], axis=-1).reshape(-1, 3)


Rows = tuple[GaussianScene, Array]
"""The scene and the marks: all that is kept per Gaussian."""


def grown(rows: Rows, capacity: int) -> Rows:
    """Adds unused rows up to a capacity."""
    before = rows[0].capacity
    more = capacity - before
    if more == 0:
        return rows

    def extended(x: Array) -> np.ndarray:
        return np.concatenate([x, np.zeros((more, *x.shape[1:]), x.dtype)])

    return _with_unused(jax.tree.map(extended, rows), before)


def kept_rows(rows: Rows, keep: np.ndarray) -> Rows:
    """Moves the rows to keep [n] to the front, in their order; the others are unused."""
    # Stable: what stays keeps its order, and with it every later result.
    order = np.argsort(~keep, kind="stable")
    return _with_unused(jax.tree.map(lambda x: np.asarray(x)[order], rows), int(keep.sum()))


def _with_unused(rows: Any, num: int) -> Rows:
    """Marks all rows from `num` on as unused, in place, and moves all to the device."""
    for array in jax.tree.leaves(rows):
        array[num:] = 0
    scene: Any = rows[0]
    scene.quats[num:, 0] = 1.0
    scene.opacity_logits[num:] = DEAD_LOGIT
    return jax.tree.map(jnp.asarray, rows)
