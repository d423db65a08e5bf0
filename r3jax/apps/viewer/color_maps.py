"""Numbers as colors, the same in the browser and in pictures.

Shape symbols: n points; H W picture size.
"""

import functools

import matplotlib
import numpy as np
from matplotlib.colors import to_rgb

from r3jax.plots import style

UNSEEN = (150, 155, 163)
"""Color of what no position sees, and of pixels that show nothing known."""

SCORES = style.SCORE_MAP
"""Colors of R and its terms, 0 to 1: red is bad."""

ORDER = style.PATH_MAP
"""Colors of the order of acquisition."""

UTILITY_MAP = "viridis"
"""Colors of the utility of a candidate or a direction, from the least to the largest."""


def to_bytes(rgb: np.ndarray) -> np.ndarray:
    """Converts colors [..., 3] in [0, 1] to uint8."""
    return np.rint(np.asarray(rgb, dtype=np.float64).clip(0.0, 1.0) * 255.0).astype(np.uint8)


CAUSE_COLORS = tuple(to_bytes(np.asarray(to_rgb(color))) for color in style.CAUSE_COLORS)
"""Colors of the causes of a utility, [3] uint8 each, in the order of `scoring.explain.CAUSES`."""


@functools.cache
def _table(name: str) -> np.ndarray:
    """Returns the 256 colors of a colormap, [256, 3] uint8."""
    colors = matplotlib.colormaps[name](np.linspace(0.0, 1.0, 256))[:, :3]
    table = np.rint(colors * 255.0).astype(np.uint8)
    table.flags.writeable = False
    return table


def paint(values: np.ndarray, name: str = SCORES) -> np.ndarray:
    """Colors numbers in [0, 1]; NaN becomes `UNSEEN`.

    Args:
        values: [...]; what lies outside [0, 1] gets the color of the nearer end.
        name: of a colormap of matplotlib.

    Returns:
        [..., 3] uint8.
    """
    is_number = ~np.isnan(values)
    index = np.rint(np.where(is_number, values, 0.0).clip(0.0, 1.0) * 255.0).astype(np.intp)
    return np.where(is_number[..., None], _table(name)[index], np.asarray(UNSEEN, np.uint8))


def linear_light(encoded: np.ndarray) -> np.ndarray:
    """Converts sRGB-encoded colors to linear light, both [..., 3] in [0, 1]."""
    low = encoded / 12.92
    return np.where(encoded <= 0.04045, low, ((encoded + 0.055) / 1.055) ** 2.4)


def css_color(color: np.ndarray | tuple[int, int, int]) -> str:
    """Writes a color of three bytes in the form of CSS, such as `#0f766e`."""
    return "#" + "".join(f"{int(part):02x}" for part in color)


def spread(values: np.ndarray) -> np.ndarray:
    """Shifts and scales numbers to [0, 1].

    If all are equal, they become 0.5. Numbers that are not finite become NaN.
    """
    values = np.asarray(values, dtype=np.float64)
    finite = np.isfinite(values)
    if not finite.any():
        return np.full(values.shape, np.nan)
    low, high = values[finite].min(), values[finite].max()
    scaled = np.where(finite, values - low, 0.0) / (high - low) if high > low else 0.5
    return np.where(finite, scaled, np.nan)
