"""The colors of an audit, the same in its point clouds and in its report."""

import numpy as np

from r3jax.apps.audit.diagnosis import CAUSES, Diagnosis
from r3jax.plots import style

COLOR_OF_CAUSE = {
    "fine": "#a7c4a0",
    "angle": style.TOO_OBLIQUE,
    "rare": "#9333ea",
    "distance": style.TOO_FAR,
    "noise": style.INCONSISTENT,
    "unseen": style.NEVER_SEEN,
}
"""Hexadecimal, by cause."""

HIDDEN = "#9ca3af"
"""Color of voxels that no standpoint sees."""


def score_colors(value: np.ndarray) -> np.ndarray:
    """RGB [n, 3] uint8 of renderabilities [n] in [0, 1]: red, yellow, green."""
    from matplotlib import colormaps

    rgba = colormaps[style.SCORE_MAP](np.clip(value, 0.0, 1.0))
    return np.rint(255.0 * np.asarray(rgba)[..., :3]).astype(np.uint8)


def cause_colors(diagnosis: Diagnosis) -> np.ndarray:
    """RGB [N, 3] uint8 of every voxel's cause."""
    table = np.array([_rgb(COLOR_OF_CAUSE[name]) for name in CAUSES], np.uint8)
    return np.where(
        diagnosis.is_seen[:, None], table[diagnosis.cause], np.array(_rgb(HIDDEN), np.uint8)
    )


def _rgb(color: str) -> tuple[int, int, int]:
    value = int(color.removeprefix("#"), 16)
    return value >> 16, (value >> 8) & 255, value & 255
