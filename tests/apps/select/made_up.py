"""Observations and targets made up by chance: what frames of no scene at all could show."""

import numpy as np

from r3jax.apps.select.observations import Observed
from r3jax.apps.select.targets import Targets
from r3jax.kernels.constants import ON_EDGE


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
        first=np.cumsum([0, *map(len, parts)]),
        row=row,
        resolution=rng.uniform(50.0, 400.0, size).astype(np.float32),
        color=rng.normal(0.5, 0.1, (size, 3)).clip(0, 1).astype(np.float32),
        is_colored=rng.random(size) < 0.8,
        position=rng.uniform(-1.0, 4.0, (frames, 3)).astype(np.float32),
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
        for name in ("row", "resolution", "color", "is_colored")
    }
    first = np.cumsum([0, *np.diff(observed.first)[order]])
    return Observed(
        key=observed.key, voxel_size=0.1, first=first, position=observed.position[order],
        sharpness=observed.sharpness[order], **columns,
    )  # fmt: skip


def renderability_of(observed: Observed, targets: Targets, frames: list[int]) -> np.ndarray:
    """R of each target from some frames, [T], pair by pair from the formulas in float64."""
    totals, center = np.zeros(len(targets)), observed.center.astype(np.float64)
    for row in range(observed.num_rows):
        seen = [
            (frame, at)
            for frame in frames
            for at in range(observed.first[frame], observed.first[frame + 1])
            if observed.row[at] == row
        ]
        if not seen:
            continue
        colors = [observed.color[at] for _, at in seen if observed.is_colored[at]]
        colors = np.array(colors, np.float64).reshape(-1, 3)
        variance = colors.var(axis=0, ddof=1).sum() if len(colors) > 1 else 0.0
        delta = float(np.clip(1.0 - np.sqrt(2 / 1.5 * variance), 0.0, 1.0))
        best = max(float(observed.resolution[at]) for _, at in seen)
        sharp = max(float(observed.sharpness[frame]) for frame, _ in seen)
        q = np.array([observed.position[frame] for frame, _ in seen], np.float64) - center[row]
        q /= np.linalg.norm(q, axis=1, keepdims=True)
        for pair in range(targets.first[row], targets.first[row + 1]):
            target = targets.target[pair]
            offset = targets.position[target].astype(np.float64) - center[row]
            distance = np.linalg.norm(offset)
            r = offset / distance
            cosine = float(np.clip((q @ r).max(), 0.0, 1.0))
            e1 = np.cross([0.0, 0.0, 1.0], r)
            flat = q[q @ r > 0.0] @ np.stack([e1, np.cross(r, e1)], axis=1)
            low, high = flat.min(axis=0, initial=np.inf), flat.max(axis=0, initial=-np.inf)
            kappa = 1.0 if (low <= ON_EDGE).all() and (high >= -ON_EDGE).all() else 2.0
            bias = cosine**kappa
            ratio = min(best * distance / float(targets.focal[target]), 1.0)
            value = bias * delta ** (kappa * (1.0 - bias)) * ratio ** (1.0 - delta * bias)
            totals[target] += targets.weight[pair] * value * sharp ** (delta * bias)
    return totals
