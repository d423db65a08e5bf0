"""Do depth images and poses tell of one world? A unit that is wrong shows without knowing any room.

A point of one depth image is where another one sees a surface, unless something hides it. With
depths that are too long or too short by a factor it is elsewhere, as soon as the cameras stood
apart: so the factor that brings most points together is known from the pictures alone. (It is
the scale of monocular reconstruction, asked the other way round.)

Shape symbols: n points; h, w size of a picture.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from r3jax.geometry.cameras import Camera

FACTORS = np.concatenate([[1e-3, 1e-2], 1.08 ** np.arange(-30, 31), [1e2, 1e3]])
"""Depths are tried as they are and multiplied by these: 0.1 to 10, and slips of units."""

_TOLERANCE = 0.05
"""Surfaces that lie so close agree, as a share of their distance: noise, edges, drift of poses."""

_POINTS, _PICTURES = 100, 24
"""Taken of each picture, and pictures taken: 50,000 comparisons for each factor."""

_LEAST = 400
"""Fewer comparisons say nothing: the pictures hardly overlap."""

_FITS = 0.9
"""Of the points agree where nothing needs to be explained."""

_THROUGH = 0.8
"""Points that others look through, for each that they see: 0.01 to 0.03 in good captures, 0.4 if
the poses are off by 5 cm, 1 and more if the poses belong to other pictures."""

_SURE = 0.2
"""A factor that brings fewer together explains nothing."""


@dataclass(frozen=True)
class Look:
    """One depth image."""

    depth: np.ndarray
    """z-depth [h, w]; 0 no measurement, inf nothing within range."""

    camera: Camera
    """Its pinhole."""

    pose: np.ndarray
    """`T_world_camera`, [4, 4] float64, in the unit of the depth."""

    def points(self, most: int, rng: np.random.Generator) -> np.ndarray:
        """Some of the points that it shows, in the camera's frame, [n, 3]."""
        row, column = np.nonzero((self.depth > 0.0) & np.isfinite(self.depth))
        if len(row) > most:
            some = rng.choice(len(row), most, replace=False)
            row, column = row[some], column[some]
        z = self.depth[row, column].astype(np.float64)
        x = (column + 0.5 - float(self.camera.cx)) / float(self.camera.fx)
        y = (row + 0.5 - float(self.camera.cy)) / float(self.camera.fy)
        return z[:, None] * np.stack([x, y, np.ones_like(x)], axis=1)


def check_agreement(looks: Sequence[Look]) -> None:
    """Refuses depth images that contradict the poses, or each other.

    Nothing is said where pictures do not overlap, or were taken from one place: no depth is wrong
    there.

    Raises:
        ValueError: another factor explains them far better; or nearly as many points lie where
            another picture looks through them as where it sees a surface.
    """
    chosen = np.unique(np.linspace(0, len(looks) - 1, _PICTURES).round().astype(int))
    pictures = _Pictures([looks[i] for i in chosen])
    count, share, seen_through = pictures.compare(1.0)
    if count < _LEAST:
        return
    found = [(*pictures.compare(factor)[:2], factor) for factor in FACTORS.tolist()]
    best, factor = max((share, factor) for number, share, factor in found if number >= _LEAST)
    is_better = best > 2.0 * share or 1.0 - share > 2.0 * (1.0 - best)
    if best > _SURE and share < _FITS and is_better and not 0.8 < factor < 1.25:
        raise ValueError(
            f"the depth images contradict the poses: {100 * share:.0f} % of what one shows is "
            f"where others see it, but {100 * best:.0f} % if every depth is multiplied by "
            f"{factor:.2g}: is the unit of depth (or of the poses) wrong? --trust-depth audits it "
            "all the same"
        )
    if seen_through > _THROUGH * share:
        raise ValueError(
            f"the frames contradict each other: {100 * seen_through:.0f} % of what one shows is "
            f"where others look through, and {100 * share:.0f} % where others see it: are the "
            "poses and the depth images of one recording, and do the axes fit? --trust-depth "
            "audits it all the same"
        )


class _Pictures:
    """Pictures that are compared, each with every other one."""

    def __init__(self, looks: Sequence[Look]):
        """Takes some points of each picture."""
        rng = np.random.default_rng(0)
        self._local = [look.points(_POINTS, rng) for look in looks]
        self._poses = np.stack([look.pose for look in looks])
        lenses = [
            [getattr(look.camera, name) for name in ("fx", "fy", "cx", "cy")] for look in looks
        ]
        self._lens = np.asarray(lenses, dtype=np.float64).T[:, :, None]
        sizes = np.array([look.depth.shape for look in looks])
        self._height, self._width = sizes.T[:, :, None]
        self._first = (np.cumsum(sizes.prod(axis=1)) - sizes.prod(axis=1))[:, None]
        self._depth = np.concatenate([look.depth.ravel() for look in looks]).astype(np.float64)

    def compare(self, factor: float) -> tuple[int, float, float]:
        """Compares them, all depths multiplied by a factor.

        Returns:
            Comparisons, the share of points that lie where the other picture sees a surface, and
            the share that it looks through.
        """
        numbers = np.zeros(3, dtype=np.int64)
        for i, (pose, local) in enumerate(zip(self._poses, self._local, strict=True)):
            ratio = self._ratios(factor * local @ pose[:3, :3].T + pose[:3, 3], i, factor)
            is_there = np.abs(ratio - 1.0) < _TOLERANCE
            numbers += len(ratio), is_there.sum(), (ratio <= 1.0 - _TOLERANCE).sum()
        count, there, through = (int(number) for number in numbers)
        return count, there / max(count, 1), through / max(count, 1)

    def _ratios(self, world: np.ndarray, own: int, factor: float) -> np.ndarray:
        """Depths of points [n, 3] over those of the surfaces that the others show there."""
        offset = world[None] - self._poses[:, None, :3, 3]
        x, y, z = np.moveaxis(offset @ self._poses[:, :3, :3], 2, 0)
        is_in = z > 0.0
        is_in[own] = False
        z = np.where(is_in, z, 1.0)
        fx, fy, cx, cy = self._lens
        column, row = np.floor(fx * x / z + cx), np.floor(fy * y / z + cy)
        is_in &= (column >= 0) & (column < self._width) & (row >= 0) & (row < self._height)
        place = np.where(is_in, self._first + row * self._width + column, 0.0).astype(np.int64)
        seen = self._depth[place]
        is_in &= (seen > 0.0) & np.isfinite(seen)
        return z[is_in] / (factor * seen[is_in])
