"""How brightness and white balance change from frame to frame, on the same surfaces.

A whole image is bright because it shows a window. So colors are compared block by block where two
frames show the same surface, and nothing is clipped; the median leaves out what shines. Values are
taken as they are stored: a splat has to explain these.

Shape symbols: n frames; k pairs.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from r3jax.apps.audit.faults.blocks import BlockImage
from r3jax.apps.audit.faults.overlap import FEWEST, Overlap, levels, neighbors_of


@dataclass(frozen=True)
class Light:
    """Brightness and tint of every frame; only differences between neighbors mean anything."""

    pairs: np.ndarray
    """Frames that were compared, [k, 2]."""

    shared: np.ndarray
    """Blocks that each pair has in common, [k]."""

    brightness: np.ndarray
    """Logarithm of the brightness that the frame gives a surface, [n]; NaN: not compared."""

    tint: np.ndarray
    """Logarithms of red and of blue over green, [n, 2]; NaN: not compared."""

    def change(self, values: np.ndarray) -> np.ndarray:
        """Values [n] beside the median of the neighbors', [n]; NaN: not compared."""
        change = np.full(len(values), np.nan)
        for i, near in enumerate(neighbors_of(len(values), self.pairs)):
            if len(near):
                change[i] = values[i] - np.median(values[near])
        return change


def light(images: Sequence[BlockImage], pairs: Sequence[Overlap]) -> Light:
    """Compares the colors of all frames."""
    count = len(images)
    found = [(o.first, o.second, *_log_ratios(images, o)) for o in pairs]
    found = [row for row in found if np.isfinite(row[2]).all()]
    linked = np.array([row[:2] for row in found], dtype=np.int64).reshape(-1, 2)
    ratios = np.array([row[2] for row in found]).reshape(-1, 3)
    shared = np.array([row[3] for row in found], dtype=np.float64)
    columns = [levels(count, linked, column, np.sqrt(shared)) for column in ratios.T]
    level = np.stack(columns, axis=1)
    level[~np.isin(np.arange(count), linked)] = np.nan
    return Light(linked, shared, level[:, 0], level[:, 1:])


def _log_ratios(images: Sequence[BlockImage], pair: Overlap) -> tuple[np.ndarray, int]:
    """Median log-ratios of brightness, red over green and blue over green, [3]; of how many."""
    own, other = pair.own[pair.agrees], pair.other[pair.agrees]
    a, b = images[pair.first].color[own], images[pair.second].color[other]
    known = np.isfinite(a[:, 0]) & np.isfinite(b[:, 0])
    if known.sum() < FEWEST:
        return np.full(3, np.nan), 0
    change = np.log(a[known] / b[known]).astype(np.float64)
    tint = change[:, [0, 2]] - change[:, [1]]
    every = np.concatenate([change.mean(axis=1, keepdims=True), tint], axis=1)
    return np.median(every, axis=0), int(known.sum())
