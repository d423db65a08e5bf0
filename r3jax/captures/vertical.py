"""Estimates the vertical and its uncertainty from cameras and surfaces.

The posterior of the vertical u on the sphere, p(u) ~ exp(C(u) + S(u)):

C: a person holds a camera upright or sideways, level to some degrees and sometimes not, and looks
rather down than up: a mixture for each pose. Poses of a path are alike, so their mean counts as
much as a dozen of independent ones.

S: floors and tables face up, ceilings down, walls to the side, and other surfaces anywhere: a
mixture for each normal of the depth images. A plane has many normals but is one observation, so
their mean counts as much as a few for each distinct direction (the exponential of the entropy), and
no more than in a furnished room: the leaves of trees face all directions and say little.

The estimate is the maximum; "within" is the angle round it that holds 95 % of the posterior.

Shape symbols: n poses; b blocks; k normals; u directions.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from r3jax.captures.alignment import evenly_spaced
from r3jax.geometry.cameras import Camera
from r3jax.geometry.sphere import fibonacci_lattice

_BLOCKS = 32
"""Blocks along the longer side of a depth image; a plane is fitted to each."""

_MEASURED = 0.6
"""Share of a block's pixels that must be measured."""

_FLAT, _MAX_ERROR = 0.02, np.radians(6.0)
"""Blocks with larger residuals (of their depth) or errors of their normal are left out."""

_ALIKE = 3.0
"""Factor on a normal's error, since errors of neighboring pixels are correlated."""

_LEVEL, _TILTED, _TILTED_SHARE = 4.0, 20.0, 0.25
"""How level cameras are held [deg], by most and by the rest of the poses."""

_SIDEWAYS, _ANYHOW = 0.1, 0.02
"""Shares of the poses held sideways (a phone upright), and in no particular orientation."""

_PITCH, _PITCH_SPREAD, _ANY_PITCH = -15.0, 30.0, 0.1
"""Elevation of most viewing directions [deg], and the share of those anywhere."""

_ANY_POSES, _PER_POSE = 4.0, 2.0
"""Observations that poses count for, and each distinct one among them."""

_FACING_UP, _FACING_DOWN, _UPRIGHT = 0.25, 0.12, 0.33
"""Shares of floors and tables, of ceilings, and of walls."""

_EVEN = np.radians(3.0)
"""Standard deviation of floors and walls from their ideals [rad]."""

_PER_PLANE, _MOST_PLANES = 1.5, 12.0
"""Observations that each distinct direction of surfaces counts for, and the most of all."""

_LATTICE, _BINS = 3000, 200
"""Directions that are tried, and bins in which directions count as distinct."""

USED_POSES, _USED_NORMALS = 32, 500
"""Evaluated of each capture, at most."""

_AROUND, _STEPS = 5.0, 25
"""Half-width [deg] and steps of the finer grid round the maximum."""

_HELD = 0.95
"""Share of the posterior that lies within the reported angle."""

_TRUST = 0.5
"""Power of the posterior for the reported angle, since observations are correlated."""

_LEAST = 3.0
"""Minimum uncertainty [deg]: floors slope, and poses drift."""

_SNAP = 8.0
"""An estimate this near to an axis [deg] is that axis, unless the evidence tells them apart."""


class Normals(NamedTuple):
    """Normals of surfaces, towards the camera that saw them."""

    direction: np.ndarray
    """In the capture's coordinates, [k, 3]."""

    weight: np.ndarray
    """Area, in any unit, [k]."""

    error: np.ndarray
    """Standard deviation [rad], [k]."""


@dataclass(frozen=True)
class Vertical:
    """The vertical of a capture."""

    direction: np.ndarray
    """In the capture's coordinates, [3], unit length."""

    within: float | None = None
    """Uncertainty of the direction [deg]; None if it was given by the user or the format."""


def upright(pose: np.ndarray, top: tuple[int, int]) -> np.ndarray:
    """Turns a pose about its axis so that a photo's top lies above, [4, 4].

    Args:
        pose: `T_world_camera`.
        top: where the top lies in the pixels, (column, row).
    """
    x, y = -top[1], top[0]  # the shown picture's right
    turned = np.eye(4)
    turned[:2, 0], turned[:2, 1] = (x, y), (-top[0], -top[1])
    return pose @ turned


def block_normals(depth: np.ndarray, camera: Camera, rotation: np.ndarray) -> Normals:
    """Fits a plane to each block of a depth image.

    In slopes (x, y) a plane a x + b y + c = 1/z has the normal (a, b, c): a linear fit.

    Args:
        depth: z-depth, [H, W]; 0 no measurement, inf nothing within range.
        camera: its pinhole.
        rotation: from the camera's axes to the capture's, [3, 3].
    """
    side = min(max(4, round(max(depth.shape) / _BLOCKS)), *depth.shape)
    rows, columns = depth.shape[0] // side, depth.shape[1] // side

    def cut(image: np.ndarray) -> np.ndarray:
        whole = image[: rows * side, : columns * side].reshape(rows, side, columns, side)
        return whole.swapaxes(1, 2).reshape(rows * columns, side * side)

    column, row = np.meshgrid(np.arange(depth.shape[1]) + 0.5, np.arange(depth.shape[0]) + 0.5)
    known = cut((depth > 0.0) & np.isfinite(depth))
    is_full = known.sum(axis=1) >= max(_MEASURED * side * side, 4)
    known = known[is_full]
    x = cut((column - float(camera.cx)) / float(camera.fx))[is_full]
    y = cut((row - float(camera.cy)) / float(camera.fy))[is_full]
    A = np.stack([x, y, np.ones_like(x)], axis=2) * known[..., None]
    nearness = known / np.where(known, cut(depth)[is_full].astype(np.float64), 1.0)
    inverse = np.linalg.inv(np.einsum("bpi,bpj->bij", A, A))
    plane = np.einsum("bij,bpj,bp->bi", inverse, A, nearness)
    count = known.sum(axis=1)
    residual = np.einsum("bpi,bi->bp", A, plane) - nearness
    spread = np.sqrt((residual**2).sum(axis=1) / (count - 3))
    length = np.linalg.norm(plane, axis=1)
    slope = np.sqrt(np.maximum(inverse[:, 0, 0], inverse[:, 1, 1]))
    error = _ALIKE * spread * slope / np.maximum(length, 1e-300)
    mean = nearness.sum(axis=1) / count
    is_plane = (length > 0.0) & (error < _MAX_ERROR) & (spread < _FLAT * mean)
    normal = -plane / np.maximum(length, 1e-300)[:, None]
    ray = A.sum(axis=1) / count[:, None]
    facing = np.abs((normal * ray).sum(axis=1)) / np.linalg.norm(ray, axis=1)
    area = 1.0 / (mean**2 * np.maximum(facing, 0.1))
    return Normals((normal @ rotation.T)[is_plane], area[is_plane], error[is_plane])


def estimated_up(poses: np.ndarray, seen: Sequence[Normals] = ()) -> Vertical:
    """Estimates the vertical of a capture.

    Args:
        poses: `T_world_camera`, [n, 4, 4], n >= 1.
        seen: normals of its surfaces, of each depth image.
    """
    rotations = poses[evenly_spaced(len(poses), USED_POSES), :3, :3]
    normals = _thinned(seen)

    def log_posterior(up: np.ndarray) -> np.ndarray:
        return _of_cameras(up, rotations) + _of_surfaces(up, normals)

    wide = fibonacci_lattice(_LATTICE)
    at_wide = log_posterior(wide)
    best = wide[np.argmax(at_wide)]
    fine, at_fine = wide, at_wide
    for _ in range(2):  # the second one has the maximum in its middle
        fine = _grid_round(best)
        at_fine = log_posterior(fine)
        best = fine[np.argmax(at_fine)]
    near = np.cos(np.radians(_AROUND))
    is_far, is_near = wide @ best < near, fine @ best >= near
    cell = (2.0 * np.tan(np.radians(_AROUND)) / (_STEPS - 1)) ** 2
    share = np.concatenate([at_wide[is_far], at_fine[is_near]])
    share = np.exp(_TRUST * (share - share.max()))
    share *= np.repeat([4.0 * np.pi / _LATTICE, cell], [is_far.sum(), is_near.sum()])
    angle = _degrees(np.concatenate([wide[is_far], fine[is_near]]) @ best)
    order = np.argsort(angle)
    held = np.searchsorted(np.cumsum(share[order]), _HELD * share.sum())
    within = max(float(angle[order[min(held, len(order) - 1)]]), _LEAST)
    axis = int(np.argmax(np.abs(best)))
    if _degrees(np.abs(best))[axis] <= min(_SNAP, within):
        best = np.sign(best[axis]) * np.eye(3)[axis]
    return Vertical(best, within)


def _degrees(cosine: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _thinned(seen: Sequence[Normals]) -> Normals:
    """Draws some normals, with weights that sum to their number of observations."""
    if not sum(len(part.weight) for part in seen):
        return Normals(np.zeros((0, 3)), np.zeros(0), np.zeros(0))
    direction, weight, error = (np.concatenate(parts) for parts in zip(*seen, strict=True))
    weight = np.minimum(weight, np.percentile(weight, 90.0))  # one far block is not all
    if len(weight) > _USED_NORMALS:
        chosen = np.random.default_rng(0).choice(len(weight), _USED_NORMALS, replace=False)
        direction, weight, error = direction[chosen], weight[chosen], error[chosen]
    count = min(_PER_PLANE * _distinct(direction, weight), _MOST_PLANES, len(weight) / 3.0)
    return Normals(direction, weight * (count / weight.sum()), error)


def _distinct(directions: np.ndarray, weight: np.ndarray) -> float:
    """Computes the effective number of different directions [k, 3]: exp of their entropy."""
    bins = fibonacci_lattice(_BINS)
    share = np.bincount(np.argmax(directions @ bins.T, axis=1), weight) / weight.sum()
    share = share[share > 0.0]
    return float(np.exp(-(share * np.log(share)).sum()))


def _of_cameras(up: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Computes C at directions [u, 3] from the cameras' axes [n, 3, 3]."""
    right, down, forward = np.moveaxis(np.einsum("ki,nij->knj", up, rotations), 2, 0)

    def level(sine: np.ndarray) -> np.ndarray:
        bells = (np.exp(-0.5 * (sine / np.sin(np.radians(s))) ** 2) for s in (_LEVEL, _TILTED))
        most, rest = bells
        return (1.0 - _TILTED_SHARE) * most + _TILTED_SHARE * rest

    elevation = np.degrees(np.arcsin(np.clip(forward, -1.0, 1.0)))
    pitched = np.exp(-0.5 * ((elevation - _PITCH) / _PITCH_SPREAD) ** 2)
    pitched = (1.0 - _ANY_PITCH) * pitched + _ANY_PITCH
    upright = down < np.sin(np.radians(_LEVEL))  # or straight down, as a drone's
    held = (1.0 - _SIDEWAYS) * level(right) * upright + _SIDEWAYS * level(down)
    likelihood = pitched * held + _ANYHOW * 0.5 * (1.0 - down)
    same = np.ones(len(rotations))
    distinct = max(_distinct(rotations[:, :, axis], same) for axis in (0, 2))
    return np.log(likelihood + 1e-4).mean(axis=1) * (_ANY_POSES + _PER_POSE * distinct)


def _of_surfaces(up: np.ndarray, normals: Normals) -> np.ndarray:
    """Computes S at directions [u, 3]: the weighted logarithms of densities on the sphere."""
    cosine = up @ normals.direction.T
    variance = _EVEN**2 + normals.error**2
    cap = 1.0 / (2.0 * np.pi * variance)
    belt = cap / np.sqrt(2.0 * np.pi / variance)
    density = (
        _FACING_UP * cap * np.exp((cosine - 1.0) / variance)
        + _FACING_DOWN * cap * np.exp(-(cosine + 1.0) / variance)
        + _UPRIGHT * belt * np.exp(-0.5 * cosine**2 / variance)
        + (1.0 - _FACING_UP - _FACING_DOWN - _UPRIGHT) / (4.0 * np.pi)
    )
    return np.log(density) @ normals.weight


def _grid_round(direction: np.ndarray) -> np.ndarray:
    """Makes a square grid of directions around one, [u, 3]."""
    across = np.linalg.svd(direction[None])[2][1:]
    steps = np.linspace(-1.0, 1.0, _STEPS) * np.tan(np.radians(_AROUND))
    x, y = (side.reshape(-1, 1) for side in np.meshgrid(steps, steps))
    grid = direction + x * across[0] + y * across[1]
    return grid / np.linalg.norm(grid, axis=1, keepdims=True)
