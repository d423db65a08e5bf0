"""Observations and targets made up by chance: what frames of no scene at all could show."""

import numpy as np

from r3jax.apps.select.observations import Observed
from r3jax.apps.select.targets import Targets


def observed_of(seed: int, frames: int = 9, rows: int = 40, scenes: int = 1) -> Observed:
    """Each frame shows a third of the rows of its scene; rows of scenes do not mix."""
    rng = np.random.default_rng(seed)
    cells = rng.choice(32**3, rows, replace=False)
    x, y, z = (np.stack(np.unravel_index(cells, (32, 32, 32))) + (1 << 20)).astype(np.uint64)
    packed = x | (y << 21) | (z << 42)
    key = np.stack([packed & 0xFFFFFFFF, packed >> 32]).astype(np.uint32)
    key = key[:, np.lexsort(key)]
    parts = []
    for frame in range(frames):
        shown = np.flatnonzero(rng.random(rows) < 0.35).astype(np.int32)
        parts.append(shown[shown % scenes == frame % scenes])
    row = np.concatenate(parts)
    size = len(row)
    return Observed(
        key=key,
        voxel_size=0.1,
        num_bins=64,
        first=np.cumsum([0, *map(len, parts)]),
        row=row,
        direction=rng.integers(0, 64, size).astype(np.uint8),
        resolution=rng.uniform(50.0, 400.0, size).astype(np.float32),
        color=rng.normal(0.5, 0.1, (size, 3)).clip(0, 1).astype(np.float32),
        is_colored=rng.random(size) < 0.8,
        sharpness=rng.choice([1.0, 0.6, 0.3], frames).astype(np.float32),
    )


def targets_of(observed: Observed, seed: int, num: int = 4) -> Targets:
    """Each target shows half of the rows, from somewhere within or beside them."""
    rng = np.random.default_rng(seed + 1)
    shown = rng.random((observed.num_rows, num)) < 0.5
    row, target = np.nonzero(shown)
    weight = rng.uniform(0.0, 1.0, len(row))
    total = np.bincount(target, weight, num)
    return Targets(
        position=rng.uniform(-1.0, 4.0, (num, 3)).astype(np.float32),
        focal=rng.uniform(100.0, 600.0, num).astype(np.float32),
        first=np.searchsorted(row, np.arange(observed.num_rows + 1)).astype(np.int64),
        target=target.astype(np.int32),
        weight=(weight / (1.1 * total[target])).astype(np.float32),
    )


def shuffled(observed: Observed, order: np.ndarray) -> Observed:
    """The same frames in another order."""
    index = np.concatenate([np.arange(observed.first[i], observed.first[i + 1]) for i in order])
    columns = {
        name: getattr(observed, name)[index]
        for name in ("row", "direction", "resolution", "color", "is_colored")
    }
    first = np.cumsum([0, *np.diff(observed.first)[order]])
    return Observed(
        key=observed.key, voxel_size=0.1, num_bins=64, first=first,
        sharpness=observed.sharpness[order], **columns,
    )  # fmt: skip
