"""Which poses contradict the depth: by how much each frame would have to move to fit the others.

One step of point-to-plane alignment (Chen and Medioni 1991) of all frames at once: a small motion
of every frame is sought that brings the surfaces of neighbors onto each other, along their normals,

    n . (p_i + d_i(p_i) - q_j - d_j(q_j)) = 0,    d(p) = t + w x (p - c)

with c the frame's own camera, by iteratively reweighted least squares (Cauchy weights), as
most of the error lies where one frame does not show what the other does. What a frame's surfaces
move beside its neighbors' is what its pose is off. A drift that all frames share does not show.

With the poses as they are, the same equations with one unknown for all frames give a systematic
error of the depths or of the camera. With x, y, z a point in its camera and r the length of the ray
(x/z, y/z, 1), each moves it, in the camera's axes, by

    scale of the depths      (x, y, z)
    focal length            -(x, y, 0)
    principal point         -(z, 0, 0) or -(0, z, 0), as a share of the focal length
    depth along the ray     -(1 - 1 / r) (x, y, z)

These are similar where frames show little; so each is fitted alone, and the one with the smallest
residual is chosen.

Shape symbols: n frames; m matches of a pair; b blocks.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from r3jax.captures.faults.blocks import FEWEST, BlockImage, Overlap, neighbors_of

_GATE = 0.15
"""Surfaces farther apart than this are different ones, as a share of their distance."""

_MATCHES = 200
"""Maximum number of matches used of a pair."""

_ROUNDS = 4
"""Iterations of the reweighting of matches."""

_PARALLEL = 0.8
"""Surfaces whose normals have a smaller cosine are different ones."""

_MOST, _APART, _BROUGHT = 90.0, 6.0, 0.4
"""Percentile of a frame's distances, the multiple of the typical one from which its pose is
off, and the share of it that moving the frame may leave. Moved along a wall a frame still fits that
wall, so few of its surfaces may tell: a shift by 5 cm gives 15 and 0.2, frames whose poses are true
2 to 3 and 0.9 to 1."""

_SIX = np.arange(6)
"""Unknowns of a frame."""

_PRIOR = 0.02
"""Standard deviation of the prior on motions: translations as a share of the median depth,
rotations in radians."""

_ALIKE = 100.0
"""Matches that err together: those of a wall in a pair of frames."""


@dataclass(frozen=True)
class _Matches:
    """Matches of one pair: rows of the equations."""

    first: int
    second: int
    rows: np.ndarray
    """What the twelve unknowns of both frames move each match along its normal, [m, 12]."""
    shared: np.ndarray
    """What each of `SYSTEMATIC` moves each match along its normal, [m, 5]."""
    error: np.ndarray
    """Distance along the normal, [m] [median depths]."""


SYSTEMATIC = ("scale", "focal", "across", "down", "ray")
"""Errors that all frames may share: the order of `_Matches.shared`."""

_NAMED_FROM = {"scale": 0.03, "focal": 0.03, "across": 0.02, "down": 0.02, "ray": 0.5}
"""Smaller ones are not named."""

_MAX_RELATIVE_DEVIATION = 1.0 / 3.0
"""Nor are those whose standard deviation is larger than this share of it."""


@dataclass(frozen=True)
class Systematic:
    """An error that all frames share."""

    kind: str
    """One of `SYSTEMATIC`."""

    value: float
    """Factor of the depths or the focal lengths, offset of the principal point [focal lengths], or
    about 1 for depth along the ray."""

    @property
    def size(self) -> float:
        """Magnitude of the error; 0 if there is none."""
        return float(np.log(self.value)) if self.kind in ("scale", "focal") else self.value


@dataclass(frozen=True)
class Offsets:
    """Errors of the poses."""

    distance: np.ndarray
    """How far the surfaces of each frame lie from where its neighbors show them, beyond what moves
    all of them, [n] [capture units]; NaN: not compared."""

    is_explained: np.ndarray
    """True where the frame's surfaces lie apart from its neighbors', of which there are two or
    more, and moving the frame brings them together, [n]. Elsewhere a distance means little: nothing
    constrains a frame that shows one wall."""

    typical: float
    """Median distance of matching surfaces along their normals [capture units]: noise of the depth
    and of the poses; NaN: nothing could be compared."""

    systematic: Systematic | None
    """What all frames have wrong; None: nothing, or not known, as where the camera only turned."""


_AT_HAND = 256
"""Frames whose surfaces are kept: neighbors are mostly those shortly before and after."""


class _Surface(NamedTuple):
    """What a frame shows, in units of the typical depth."""

    points: np.ndarray
    """[b, 3]."""

    normals: np.ndarray
    """[b, 3]; NaN at edges."""

    pose: np.ndarray
    """`T_world_camera`, [4, 4] [capture units]."""

    unit: float
    """Typical depth [capture units]."""

    @property
    def center(self) -> np.ndarray:
        """Position of the camera, [3]."""
        return self.pose[:3, 3] / self.unit

    def moves(self, blocks: np.ndarray) -> np.ndarray:
        """Computes the moves of some blocks by what all frames may have wrong, [5, m, 3]."""
        return _shared(self.points[blocks] - self.center, self.pose[:3, :3])


def offsets(images: Sequence[BlockImage], pairs: Sequence[Overlap]) -> Offsets:
    """Aligns all frames by a small motion each."""
    count = len(images)
    unit = float(np.median([d for d in (image.median_depth for image in images) if d > 0.0] or [1]))

    @functools.lru_cache(maxsize=_AT_HAND)
    def surface(i: int) -> _Surface:
        points = images[i].points / unit
        return _Surface(points, _normals(points, images[i].shape), images[i].pose, unit)

    found = [_matched(pair, surface(pair.first), surface(pair.second)) for pair in pairs]
    matches = [match for match in found if len(match.error) >= FEWEST]
    if not matches:
        unknown = np.full(count, np.nan)
        return Offsets(unknown, np.zeros(count, dtype=bool), float("nan"), None)
    motion = _solved(count, matches)
    linked = np.array([(match.first, match.second) for match in matches], dtype=np.int64)
    distance = np.full(count, np.nan)
    for i, near in enumerate(neighbors_of(count, linked)):
        if len(near):
            own = surface(i).points
            own = own[np.isfinite(own[:, 0])]
            centers = {j: images[j].pose[:3, 3] / unit for j in (i, *near.tolist())}
            moved = [_moved(motion[j], own - center) for j, center in centers.items()]
            beside = moved[0] - np.median(moved[1:], axis=0)
            distance[i] = unit * float(np.median(np.linalg.norm(beside, axis=1)))
    typical = float(np.median(np.abs(np.concatenate([match.error for match in matches]))))
    explained = _explained(count, matches, motion, typical)
    return Offsets(distance, explained, unit * typical, _systematic(matches))


def _explained(
    count: int, matches: list[_Matches], motion: np.ndarray, typical: float
) -> np.ndarray:
    """Returns a mask of the frames that the motion explains, [n]: see `Offsets.is_explained`."""
    before, after = ([list[np.ndarray]() for _ in range(count)] for _ in range(2))
    for match in matches:
        left = match.error + match.rows @ motion[[match.first, match.second]].ravel()
        for i in (match.first, match.second):
            before[i].append(np.abs(match.error))
            after[i].append(np.abs(left))
    explained = np.zeros(count, dtype=bool)
    for i in range(count):
        if len(before[i]) >= 2:
            apart, left = (np.percentile(np.concatenate(x[i]), _MOST) for x in (before, after))
            explained[i] = apart > _APART * typical and left < _BROUGHT * apart
    return explained


def _normals(points: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Computes the unit normals of the surfaces from neighboring blocks, [b, 3]; NaN at edges."""
    grid = points.reshape(*shape, 3)
    normal = np.full(grid.shape, np.nan)
    across = grid[1:-1, 2:] - grid[1:-1, :-2]
    down = grid[2:, 1:-1] - grid[:-2, 1:-1]
    crossed = np.cross(across, down)
    length = np.linalg.norm(crossed, axis=-1, keepdims=True)
    # At an edge between two surfaces the middle is not halfway between its neighbors.
    width = np.maximum(np.linalg.norm(across, axis=-1), np.linalg.norm(down, axis=-1))
    bent = np.linalg.norm(
        grid[1:-1, 2:] + grid[1:-1, :-2] + grid[2:, 1:-1] + grid[:-2, 1:-1] - 4 * grid[1:-1, 1:-1],
        axis=-1,
    )
    is_flat = (bent < 0.25 * width)[..., None] & (length > 0.0)
    normal[1:-1, 1:-1] = np.where(is_flat, crossed / np.where(length > 0.0, length, 1.0), np.nan)
    return normal.reshape(-1, 3)


def _shared(offset: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Computes the move of points [b, 3] from the camera by each of `SYSTEMATIC`, [5, b, 3]."""
    local = offset @ rotation
    z = local[:, 2:]
    aside = offset - z * rotation[:, 2]
    shorter = 1.0 - z / np.linalg.norm(local, axis=1, keepdims=True)
    return np.stack([offset, -aside, -z * rotation[:, 0], -z * rotation[:, 1], -shorter * offset])


def _matched(pair: Overlap, first: _Surface, second: _Surface) -> _Matches:
    """Builds the equations of one pair."""
    is_near = np.abs(pair.ratio - 1.0) < _GATE
    own, other = pair.own[is_near], pair.other[is_near]
    normal = second.normals[other]
    # NaN where either has no normal.
    flat = np.flatnonzero(np.einsum("ij,ij->i", normal, first.normals[own]) > _PARALLEL)
    flat = flat[:: max(1, -(-len(flat) // _MATCHES))]
    own, other, normal = own[flat], other[flat], normal[flat]
    p, q = first.points[own], second.points[other]
    turn = lambda x, center: np.cross(x - center, normal)
    rows = [normal, turn(p, first.center), -normal, -turn(q, second.center)]
    along = lambda x: np.einsum("ij,ij->i", normal, x)
    moves = first.moves(own) - second.moves(other)
    return _Matches(
        pair.first,
        pair.second,
        np.concatenate(rows, axis=1),
        np.einsum("kij,ij->ik", moves, normal),
        along(p - q),
    )


def _solved(count: int, matches: list[_Matches]) -> np.ndarray:
    """Solves for the motion of each frame: translation and rotation, [n, 6]."""
    scale = _scatter(np.concatenate([match.error for match in matches]))
    size = 6 * count
    own = np.stack([np.r_[6 * m.first + _SIX, 6 * m.second + _SIX] for m in matches])  # [k, 12]
    row, column = np.broadcast_arrays(own[:, :, None], own[:, None, :])
    x, prior = np.zeros(size), sparse.identity(size, format="csc") / _PRIOR**2
    for _ in range(_ROUNDS):
        left, right = [], np.zeros(size)
        for unknowns, match in zip(own, matches, strict=True):
            weight = _weight(match.error + match.rows @ x[unknowns], scale)
            weighted = match.rows * weight[:, None]
            left.append(weighted.T @ match.rows)
            right[unknowns] -= weighted.T @ match.error
        places = row.ravel(), column.ravel()
        normal = sparse.coo_matrix((np.stack(left).ravel(), places), (size, size)).tocsc()
        x = np.asarray(spsolve(normal + prior, right))
    return x.reshape(count, 6)


def _systematic(matches: list[_Matches]) -> Systematic | None:
    """Finds the one of `SYSTEMATIC` that explains most, or None if it is small or uncertain."""
    error = np.concatenate([match.error for match in matches])
    shared = np.concatenate([match.shared for match in matches])
    fits = [_fit(error, column) for column in shared.T]
    scatter = _scatter(error)
    left = [
        np.log1p(((error + size * column) / scatter) ** 2).mean()
        for (size, _), column in zip(fits, shared.T, strict=True)
    ]
    best = int(np.argmin(left))
    kind, (size, deviation) = SYSTEMATIC[best], fits[best]
    large = size if kind == "ray" else abs(size)
    if large < _NAMED_FROM[kind] or deviation > _MAX_RELATIVE_DEVIATION * _NAMED_FROM[kind]:
        return None
    return Systematic(kind, float(np.exp(size)) if kind in ("scale", "focal") else size)


def _fit(error: np.ndarray, moved: np.ndarray) -> tuple[float, float]:
    """Fits the multiple of a move [m] that cancels errors [m], and its standard deviation."""
    size = information = 0.0
    for _ in range(4 * _ROUNDS):
        left = error + size * moved
        weight = _weight(left, _scatter(left))
        information = float((weight * moved**2).sum()) + 1e-12
        size = -float((weight * moved * error).sum()) / information
    # Neighboring matches have correlated errors: `_ALIKE` of them count as one.
    return size, float(np.sqrt(_ALIKE / max(information, 1e-12)))


def _scatter(errors: np.ndarray) -> float:
    """Estimates the standard deviation of errors from their median, robust against outliers."""
    return max(1.4826 * float(np.median(np.abs(errors))), 1e-4)


def _weight(error: np.ndarray, scatter: float) -> np.ndarray:
    """Computes Cauchy weights of matches."""
    return 1.0 / (1.0 + (error / (2.0 * scatter)) ** 2) / scatter**2


def _moved(motion: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Applies a motion [6] to points at offsets [m, 3] from its center: their shifts, [m, 3]."""
    return motion[:3] + np.cross(motion[3:], offset)
