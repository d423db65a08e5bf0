"""Computes the objective, the mean renderability of targets, and the gain of one more frame.

A frame observes rows of the map of all frames: a direction, a resolution, a color. For the
frames chosen so far a row has a count, a mean color, a spread and a best resolution; a pair of a
row and a target that shows it has the nearest seen direction and the sides of kappa's box. Each of
these is updated by another observation in constant time, so that computing a gain is linear in the
number of observations of the frame.

A frame shows a row if nothing that it measured hides it, also where none of its pixels fell into
the voxel: noise and drift spread a surface over several layers of voxels, and a picture shows all
of them. Rows that count only where a pixel falls would favor the frames with the worst depth.

Directions are those of the cameras themselves, not bins: where a camera moves by little, bins 20
degrees apart would soon call everything well seen. The value is that of `scoring.terms` for the
frames chosen, times

    s^(delta b),   s the sharpness (1 / blur in pixels) of the sharpest frame that shows the row

In R, resolution has the power 1 - delta b: it matters
where a view must interpolate, but at the exact place of a frame that frame counts as ground truth.
A blurred frame is not ground truth. With this factor its blur counts in full from everywhere, until
a sharp frame shows the same surface. `kernels.scoring.frame_gains` is the same in machine code, and
tests compare it with these formulas.

Shape symbols: N rows; P pairs; T targets; n frames; m observations.
"""

from typing import Any, NamedTuple

import numpy as np

from r3jax.apps.select.observations import Observed
from r3jax.apps.select.targets import Targets
from r3jax.kernels.constants import ON_EDGE
from r3jax.kernels.native.platform import missing_for_machine_code

_ALL_SIDES = 15


class Objective:
    """Mean renderability of targets, updated in place as frames are added."""

    def __init__(self, observed: Observed, targets: Targets, *, uses_kernel: bool | None = None):
        """Starts with no frame chosen.

        Args:
            observed: observations of every frame.
            targets: views whose renderability counts.
            uses_kernel: True for machine code, False for the formula; None: machine code if
                available.
        """
        num, pairs = observed.num_rows, len(targets.target)
        self._observed, self._targets, self._center = observed, targets, observed.center
        self._count, self._m2 = np.zeros(num, np.float32), np.zeros(num, np.float32)
        self._mean, self._resolution = np.zeros((num, 3), np.float32), np.zeros(num, np.float32)
        self._sharpness = np.zeros(num, np.float32)
        self._cosine, self._value = np.zeros(pairs, np.float32), np.zeros(pairs, np.float32)
        self._sides = np.zeros(pairs, np.uint8)
        self._totals = np.zeros(len(targets))
        self._uses_kernel = not missing_for_machine_code() if uses_kernel is None else uses_kernel

    @property
    def per_target(self) -> np.ndarray:
        """Renderability of each target, [T]."""
        return self._totals.copy()

    @property
    def value(self) -> float:
        """Mean over the targets."""
        return float(self._totals.mean())

    def gains(self, frames: np.ndarray) -> np.ndarray:
        """Computes the gain of each of some frames [c], [c]."""
        if self._uses_kernel:
            from r3jax.kernels.scoring import frame_gains

            found = frame_gains.gains(*self._structs(), np.asarray(frames, np.int64))
        else:
            found = np.array([self._changed(int(frame)).gain.sum() for frame in frames])
        return found / len(self._targets)

    def add(self, frame: int) -> None:
        """Adds a frame to the selection."""
        if self._uses_kernel:
            from r3jax.kernels.scoring import frame_gains

            frame_gains.add(*self._structs(), frame, self._totals)
            return
        after = self._changed(frame)
        self._count[after.row], self._mean[after.row] = after.counts, after.mean
        self._m2[after.row], self._resolution[after.row] = after.m2, after.resolution
        self._sharpness[after.row] = after.sharpness
        self._cosine[after.pair], self._sides[after.pair] = after.cosine, after.sides
        self._value[after.pair] = after.value
        target = self._targets.target[after.pair]
        self._totals += np.bincount(target, after.gain, len(self._targets))

    def _structs(self) -> tuple[Any, Any, Any, Any]:
        """Returns the arrays in the layout of the kernel."""
        from r3jax.kernels.scoring import frame_gains as kernel

        seen, to = self._observed, self._targets
        return (
            kernel.Rows(
                self._center, self._count, self._mean, self._m2, self._resolution, self._sharpness
            ),
            kernel.Pairs(to.first, to.target, to.weight, self._cosine, self._sides, self._value),
            kernel.Observations(
                seen.first,
                seen.row,
                seen.resolution,
                seen.color,
                seen.is_colored,
                seen.position,
                seen.sharpness,
            ),
            kernel.Targets(to.position, to.focal),
        )

    def _changed(self, frame: int) -> "_Changed":
        """Computes the rows and pairs that a frame changes, with their values and gains."""
        seen, to = self._observed, self._targets
        part = slice(int(seen.first[frame]), int(seen.first[frame + 1]))
        rows, colored = seen.row[part], seen.is_colored[part]
        before = self._count[rows]
        count = before + colored
        gap = np.where(colored[:, None], seen.color[part] - self._mean[rows], 0.0)
        safe = np.maximum(count, 1.0)
        mean = self._mean[rows] + gap / safe[:, None]
        m2 = self._m2[rows] + (gap**2).sum(axis=1) * before / safe
        best = np.maximum(self._resolution[rows], seen.resolution[part])
        sharp = np.maximum(self._sharpness[rows], seen.sharpness[frame])
        length = to.first[rows + 1] - to.first[rows]
        at = np.repeat(np.arange(len(rows)), length)
        pair = np.arange(length.sum()) + np.repeat(
            to.first[rows] - np.cumsum(length) + length, length
        )
        center = self._center[rows]
        r, distance = _direction(to.position[to.target[pair]] - center[at])
        q = _direction(seen.position[frame] - center)[0][at]
        cosine = (q * r).sum(axis=1)
        sides = self._sides[pair] | np.where(cosine > 0.0, _sides(q, r), 0).astype(np.uint8)
        cosine = np.clip(np.maximum(cosine, self._cosine[pair]), 0.0, 1.0)
        value = _value(
            cosine, sides == _ALL_SIDES, _consistency(count, m2)[at],
            np.minimum(best[at] * distance / to.focal[to.target[pair]], 1.0), sharp[at],
        )  # fmt: skip
        gain = to.weight[pair] * (value - self._value[pair]).astype(np.float64)
        return _Changed(rows, count, mean, m2, best, sharp, pair, cosine, sides, value, gain)


class _Changed(NamedTuple):
    """Rows and pairs that a frame changes, with their new values."""

    row: np.ndarray
    counts: np.ndarray
    mean: np.ndarray
    m2: np.ndarray
    resolution: np.ndarray
    sharpness: np.ndarray
    pair: np.ndarray
    cosine: np.ndarray
    sides: np.ndarray
    value: np.ndarray
    gain: np.ndarray


def _direction(offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Computes unit vectors and lengths of offsets [p, 3]."""
    length = np.maximum(np.linalg.norm(offset, axis=1), 1e-6)
    return offset / length[:, None], length


def _sides(q: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Computes a bit for each side of the tangent axes at r on which q lies, [P]."""
    x, y, z = r.T
    is_pole = x * x + y * y < 1e-12
    a_x, a_y = np.where(is_pole, 1.0, -y), np.where(is_pole, 0.0, x)
    a = q[:, 0] * a_x + q[:, 1] * a_y
    b = q[:, 0] * -z * a_y + q[:, 1] * z * a_x + q[:, 2] * (x * a_y - y * a_x)
    return (a <= ON_EDGE) + 2 * (a >= -ON_EDGE) + 4 * (b <= ON_EDGE) + 8 * (b >= -ON_EDGE)


def _consistency(count: np.ndarray, m2: np.ndarray) -> np.ndarray:
    spread = np.sqrt(2.0 / 1.5 * m2 / np.maximum(count - 1.0, 1.0))
    return np.where(count > 1.0, np.clip(1.0 - spread, 0.0, 1.0), 1.0)


def _value(
    cosine: np.ndarray,
    is_inside: np.ndarray,
    delta: np.ndarray,
    ratio: np.ndarray,
    sharpness: np.ndarray,
) -> np.ndarray:
    """Computes R of pairs (`scoring.terms`), reduced by blur."""
    kappa = np.where(is_inside, 1.0, 2.0)
    bias = cosine**kappa
    near = delta * bias
    return bias * delta ** (kappa * (1.0 - bias)) * ratio ** (1.0 - near) * sharpness**near
