"""The map as a dictionary: Algorithms 1 and 2 in float64 NumPy, two passes, no hashing.

Written from the paper and the design, not from the package; only the layout of `MapState` is
shared, in `read_map`.
"""

from typing import NamedTuple

import numpy as np

from r3jax.mapping.state import MapState

Voxel = tuple[int, int, int]


class Row(NamedTuple):
    """Statistics of one voxel."""

    bins: frozenset[int]
    count: float
    mean: np.ndarray
    m2: float
    resolution: float


def lattice(num: int) -> np.ndarray:
    """Fibonacci directions, [num, 3], by the design's formula."""
    k = np.arange(num)
    z = 1.0 - 2.0 * (k + 0.5) / num
    azimuth = 2.0 * np.pi * k / ((1.0 + np.sqrt(5.0)) / 2.0)
    radius = np.sqrt(1.0 - z**2)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)


class ReferenceMap:
    """Keeps every observation and works out the statistics when asked."""

    def __init__(self, voxel_size: float, num_bins: int) -> None:
        self.voxel_size = voxel_size
        self.lattice = lattice(num_bins)
        self.colors: dict[Voxel, list[np.ndarray]] = {}
        self.bins: dict[Voxel, set[int]] = {}
        self.resolutions: dict[Voxel, list[float]] = {}
        self.clearance = np.inf
        """Smallest lead of a nearest bin's cosine over the second: below 1e-6 float32 may err."""

    def see(self, points: np.ndarray, rgb: np.ndarray, position: np.ndarray, focal: float) -> None:
        """One frame: one observation per touched voxel. Each point may have its own position."""
        points, rgb = np.float64(points), np.float64(rgb)
        positions = np.broadcast_to(np.float64(position), points.shape)
        pixels: dict[Voxel, list[int]] = {}
        for i, index in enumerate(np.floor(points / self.voxel_size).astype(int)):
            pixels.setdefault((int(index[0]), int(index[1]), int(index[2])), []).append(i)
        for voxel, members in pixels.items():
            offset = positions[members].mean(axis=0) - (np.array(voxel) + 0.5) * self.voxel_size
            distance = np.linalg.norm(offset)
            cosine = self.lattice @ (offset / distance)
            best, second = np.sort(cosine)[::-1][:2]
            self.clearance = min(self.clearance, best - second)
            self.bins.setdefault(voxel, set()).add(int(cosine.argmax()))
            self.colors.setdefault(voxel, []).append(rgb[members].mean(axis=0))
            self.resolutions.setdefault(voxel, []).append(focal / distance)

    def rows(self) -> dict[Voxel, Row]:
        """Statistics of every voxel seen so far."""
        return {
            voxel: Row(
                bins=frozenset(self.bins[voxel]),
                count=len(colors),
                mean=np.mean(colors, axis=0),
                m2=float(np.sum((colors - np.mean(colors, axis=0)) ** 2)),
                resolution=max(self.resolutions[voxel]),
            )
            for voxel, colors in self.colors.items()
        }


def read_map(state: MapState) -> dict[Voxel, Row]:
    """The occupied rows of a map, keyed by voxel; fails if a voxel has two rows."""
    key = np.asarray(state.key).astype(np.int64)
    visited = np.asarray(state.visited)
    rows: dict[Voxel, Row] = {}
    for i in np.flatnonzero(np.asarray(state.occupied)):
        packed = int(key[0, i]) + (int(key[1, i]) << 32)
        x, y, z = ((packed >> shift) % (1 << 21) - (1 << 20) for shift in (0, 21, 42))
        assert (x, y, z) not in rows, f"voxel {(x, y, z)} has two rows"
        words = [int(word) for word in visited[:, i]]
        rows[x, y, z] = Row(
            bins=frozenset(b for b in range(32 * len(words)) if words[b // 32] >> (b % 32) & 1),
            count=float(state.count[i]),
            mean=np.asarray(state.mean)[:, i],
            m2=float(state.m2[i]),
            resolution=float(state.resolution[i]),
        )
    return rows


def assert_same_rows(actual: dict[Voxel, Row], expected: dict[Voxel, Row]) -> None:
    """Same voxels, bins and counts exactly; moments and resolutions to float32 rounding."""
    assert set(actual) == set(expected)
    if not actual:
        return
    for voxel in expected:
        assert actual[voxel].bins == expected[voxel].bins, f"bins of {voxel}"
        assert actual[voxel].count == expected[voxel].count, f"count of {voxel}"
    column = lambda rows, field: np.array([getattr(rows[voxel], field) for voxel in expected])
    for field, atol in (("mean", 2e-6), ("m2", 1e-5), ("resolution", 0.0)):
        np.testing.assert_allclose(
            column(actual, field), column(expected, field), rtol=1e-5, atol=atol, err_msg=field
        )
