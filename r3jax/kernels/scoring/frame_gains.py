"""What a frame adds to the renderability of targets: `apps.select.objective` in machine code.

A voxel's row and each pair (row, target) keep what another observation needs to be added in
constant time: moments of the color and the best resolution; the best cosine, and on which sides of
the target's direction voxel directions lie, which is all that kappa's box asks.

Shape symbols: N rows; P pairs, row by row; T targets; n frames; m observations, frame by frame;
c candidates.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math
from typing import Any, NamedTuple

import numpy as np
from numba import prange

from r3jax.kernels.constants import ON_EDGE
from r3jax.kernels.native.arithmetic import exp2, log2
from r3jax.kernels.native.compiled import called_from_python, inlined_fused
from r3jax.kernels.native.ffi import num_workers, require_threads
from r3jax.kernels.scoring.terms import bias_of, consistency, log2_or_never, product_of_terms

_ZERO, _ONE, _LEAST = np.float32(0.0), np.float32(1.0), np.float32(1e-6)
_POLE, _EDGE = np.float32(1e-12), np.float32(ON_EDGE)
_ALL_SIDES = np.uint8(15)


class Rows(NamedTuple):
    """Voxels, and what the frames chosen so far say of them."""

    center: Any
    """[N, 3] float32 [m]."""

    count: Any
    """Observations with a color, [N] float32."""

    mean: Any
    """Of the colors, [N, 3] float32."""

    m2: Any
    """Sum of squared deviations, [N] float32."""

    resolution: Any
    """Best [px/m], [N] float32."""

    sharpness: Any
    """Of the sharpest frame, in (0, 1]; 0 before any, [N] float32."""


class Pairs(NamedTuple):
    """Which target shows which row, sorted by row."""

    first: Any
    """First pair of each row, and the number of pairs, [N + 1] int64."""

    target: Any
    """[P] int32."""

    weight: Any
    """Share of the target's pixels, [P] float32."""

    cosine: Any
    """To the nearest seen direction, in [0, 1], [P] float32."""

    sides: Any
    """A bit for each side of the target's direction on which a seen direction lies, [P] uint8."""

    value: Any
    """Renderability, [P] float32."""


class Observations(NamedTuple):
    """What each frame says of the rows that it shows, frame by frame."""

    first: Any
    """First observation of each frame, and their number, [n + 1] int64."""

    row: Any
    """[m] int32, ascending within a frame."""

    resolution: Any
    """[px/m], [m] float32."""

    color: Any
    """[m, 3] float32."""

    is_colored: Any
    """False where no pixel fell into the voxel, which was seen anyway, [m]."""

    position: Any
    """Camera center of each frame, [n, 3] float32 [m]."""

    sharpness: Any
    """Of each frame, in (0, 1], [n] float32."""


class Targets(NamedTuple):
    """Views whose renderability counts."""

    position: Any
    """[T, 3] float32 [m]."""

    focal: Any
    """[T] float32 [px]."""


@inlined_fused
def _color_after(rows, row, color, at):
    """Returns moments of a row after another color (Welford): count, three means, m2."""
    count = rows.count[row]
    after = count + _ONE
    d0, d1 = color[at, 0] - rows.mean[row, 0], color[at, 1] - rows.mean[row, 1]
    d2 = color[at, 2] - rows.mean[row, 2]
    m2 = rows.m2[row] + (d0 * d0 + d1 * d1 + d2 * d2) * count / after
    return after, rows.mean[row, 0] + d0 / after, rows.mean[row, 1] + d1 / after, (
        rows.mean[row, 2] + d2 / after
    ), m2  # fmt: skip


@inlined_fused
def _towards(position, camera, center, row):
    """Returns the unit vector from a voxel to a camera, and their distance."""
    x = position[camera, 0] - center[row, 0]
    y = position[camera, 1] - center[row, 1]
    z = position[camera, 2] - center[row, 2]
    distance = max(math.sqrt(x * x + y * y + z * z), _LEAST)
    inverse = _ONE / distance
    return x * inverse, y * inverse, z * inverse, distance


@inlined_fused
def _pair_after(rows, pairs, targets, row, pair, q, delta, log_delta, best, log_sharp):
    """Returns cosine, sides and renderability of a pair after another direction q was seen."""
    target = pairs.target[pair]
    x, y, z, distance = _towards(targets.position, target, rows.center, row)
    cosine, sides = q[0] * x + q[1] * y + q[2] * z, pairs.sides[pair]
    if cosine > _ZERO:
        is_pole = x * x + y * y < _POLE
        a_x, a_y = (_ONE if is_pole else -y), (_ZERO if is_pole else x)
        b_x, b_y, b_z = -z * a_y, z * a_x, x * a_y - y * a_x
        a = q[0] * a_x + q[1] * a_y
        b = q[0] * b_x + q[1] * b_y + q[2] * b_z
        sides |= np.uint8(a <= _EDGE) | np.uint8(2 * (a >= -_EDGE))
        sides |= np.uint8(4 * (b <= _EDGE)) | np.uint8(8 * (b >= -_EDGE))
    cosine = min(max(cosine, pairs.cosine[pair]), _ONE)
    is_inside = sides == _ALL_SIDES
    value = product_of_terms(
        cosine, is_inside, distance, delta, log_delta, best, targets.focal[target]
    )
    if log_sharp < _ZERO:
        value *= exp2(delta * bias_of(cosine, is_inside) * log_sharp)
    return cosine, sides, value


@inlined_fused
def _row_after(rows, observations, at):
    """Returns moments, consistency and best resolution of a row after an observation."""
    row = observations.row[at]
    count, m0, m1, m2, spread = (
        rows.count[row], rows.mean[row, 0], rows.mean[row, 1], rows.mean[row, 2], rows.m2[row]
    )  # fmt: skip
    if observations.is_colored[at]:
        count, m0, m1, m2, spread = _color_after(rows, row, observations.color, at)
    delta = consistency(count, spread, False)
    best = max(rows.resolution[row], observations.resolution[at])
    return count, m0, m1, m2, spread, delta, best


@called_from_python(parallel=True)
def _gains(rows, pairs, observations, targets, candidates, workers, out):
    num = candidates.shape[0]
    for worker in prange(workers):
        for c in range(worker, num, workers):
            frame, total = candidates[c], 0.0
            for at in range(observations.first[frame], observations.first[frame + 1]):
                row = observations.row[at]
                begin, end = pairs.first[row], pairs.first[row + 1]
                if begin == end:
                    continue
                _, _, _, _, _, delta, best = _row_after(rows, observations, at)
                log_delta = log2_or_never(delta)
                log_sharp = log2(max(rows.sharpness[row], observations.sharpness[frame]))
                x, y, z, _ = _towards(observations.position, frame, rows.center, row)
                q = x, y, z
                for pair in range(begin, end):
                    _, _, value = _pair_after(
                        rows, pairs, targets, row, pair, q, delta, log_delta, best, log_sharp
                    )
                    total += pairs.weight[pair] * (value - pairs.value[pair])
            out[c] = total


@called_from_python()
def _add(rows, pairs, observations, targets, frame, totals):
    for at in range(observations.first[frame], observations.first[frame + 1]):
        row = observations.row[at]
        count, m0, m1, m2, spread, delta, best = _row_after(rows, observations, at)
        rows.count[row], rows.m2[row], rows.resolution[row] = count, spread, best
        rows.mean[row, 0], rows.mean[row, 1], rows.mean[row, 2] = m0, m1, m2
        log_delta = log2_or_never(delta)
        rows.sharpness[row] = max(rows.sharpness[row], observations.sharpness[frame])
        log_sharp = log2(rows.sharpness[row])
        x, y, z, _ = _towards(observations.position, frame, rows.center, row)
        q = x, y, z
        for pair in range(pairs.first[row], pairs.first[row + 1]):
            cosine, sides, value = _pair_after(
                rows, pairs, targets, row, pair, q, delta, log_delta, best, log_sharp
            )
            change = pairs.weight[pair] * (value - pairs.value[pair])
            totals[pairs.target[pair]] += change
            pairs.cosine[pair], pairs.sides[pair], pairs.value[pair] = cosine, sides, value


def gains(
    rows: Rows,
    pairs: Pairs,
    observations: Observations,
    targets: Targets,
    candidates: np.ndarray,
) -> np.ndarray:
    """Computes what each of some frames would add to the sum of the targets' renderability, [c].

    Args:
        rows: as the frames chosen so far have left them.
        pairs: the same.
        observations: of all frames.
        targets: whose renderability counts.
        candidates: numbers of the frames, [c] int64.
    """
    require_threads()
    out = np.empty(len(candidates))
    _gains(rows, pairs, observations, targets, candidates, num_workers(), out)
    return out


def add(
    rows: Rows,
    pairs: Pairs,
    observations: Observations,
    targets: Targets,
    frame: int,
    totals: np.ndarray,
) -> None:
    """Adds a frame to rows and pairs, and what it gives each target to `totals` [T], in place."""
    _add(rows, pairs, observations, targets, frame, totals)
