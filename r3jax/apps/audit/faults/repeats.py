"""Which frames repeat each other: nearly the same pose, nearly the same pixels.

Shape symbols: n frames.
"""

from collections.abc import Sequence

import numpy as np

from r3jax.apps.audit.faults.blocks import BlockImage
from r3jax.geometry.cameras import angle_between

_MOVED = 0.005
"""Views whose images are shifted by less show the same [share of the width]: 3 of 640 pixels."""

_DIFFERS = 4.0
"""Largest mean difference of the blocks' colors of frames that are alike (of 255)."""


def repeats(images: Sequence[BlockImage]) -> list[list[int]]:
    """Groups of frames that repeat each other, each in order, the largest first.

    Every frame of a group repeats its first one: a slow pan is no chain of repetitions.
    """
    place = np.stack([image.pose[:3, 3] for image in images])
    groups: list[list[int]] = []
    grouped = np.zeros(len(images), dtype=bool)
    for i, image in enumerate(images):
        if grouped[i]:
            continue
        depth = image.median_depth
        reach = _MOVED * image.camera.width / float(image.camera.fx)
        apart = np.linalg.norm(place - place[i], axis=1) / (depth if np.isfinite(depth) else 1.0)
        near: list[int] = np.flatnonzero((apart < reach) & ~grouped).tolist()
        alike = [j for j in near if j == i or (j > i and _is_like(image, images[j], reach))]
        if len(alike) > 1:
            grouped[alike] = True
            groups.append(alike)
    return sorted(groups, key=lambda group: (-len(group), group))


def _is_like(a: BlockImage, b: BlockImage, reach: float) -> bool:
    """True if two frames from one place show the same pixels."""
    if a.shape != b.shape:
        return False
    difference = np.abs(a.color - b.color)
    known = np.isfinite(difference)
    if angle_between(a.pose, b.pose) > reach or not known.any():
        return False
    return float(difference[known].mean()) < _DIFFERS
