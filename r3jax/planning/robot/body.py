"""The space that a robot, a drone or a person takes up.

Imports nothing heavy, because command-line options use it. `robot.room` finds where it fits.
"""

import math
from dataclasses import dataclass
from typing import Literal

from r3jax.errors import InputError


@dataclass(frozen=True)
class Body:
    """The body that must fit at the camera's positions: a footprint with a height, or a sphere.

    Raises:
        ValueError: an invalid size.
    """

    footprint: float | tuple[tuple[float, float], ...] = 0.25
    """Radius of a disk round the vertical through the camera [m], or corners of a polygon, x ahead
    and y to the left of it [m]. A polygon needs enough space to turn in place."""

    heights: tuple[float, float | None] | None = (0.0, None)
    """Lowest and highest part above the floor [m]; None for the highest: the camera. None for both:
    a sphere round the camera, which flies."""

    margin: float = 0.05
    """Additional clearance [m]; voxels of the map are not more accurate."""

    step: float = 0.1
    """Obstacles up to this height above the floor are driven or stepped over [m]."""

    floor: float | None = None
    """Height of the floor at the start, world [m]; None: detected."""

    unknown_below: Literal["free", "never"] = "free"
    """Treatment of unknown cells below the camera: `free` where the floor was seen there or around
    the robot's position; or `never`."""

    def __post_init__(self) -> None:
        """Refuses invalid sizes, and says what to do."""
        corners = self.footprint
        if isinstance(corners, tuple):
            flat = [float(x) for corner in corners for x in corner]
            is_polygon = len(corners) >= 3 and len(flat) == 2 * len(corners)
            if not (is_polygon and all(map(math.isfinite, flat))):
                raise InputError(
                    "a footprint is a radius [m], or at least three corners [x, y] [m], got "
                    f"{corners}"
                )
        if not 0.0 < self.radius <= 10.0:
            raise InputError(f"footprint must be larger than 0 and at most 10 m, got {corners}")
        if self.heights is not None:
            low, high = self.heights
            if not (0.0 <= low < math.inf and (high is None or low <= high < math.inf)):
                raise InputError(
                    "heights of a body are above the floor, the lowest part first [m], got "
                    f"{self.heights}"
                )
        for name in ("margin", "step"):
            value = getattr(self, name)
            if not 0.0 <= value < math.inf:
                raise InputError(f"{name} must be a finite length >= 0 [m], got {value}")
        if self.unknown_below not in ("free", "never"):
            raise InputError(f"unknown_below must be `free` or `never`, got {self.unknown_below!r}")

    @property
    def radius(self) -> float:
        """Radius of the disk in which the footprint turns [m]."""
        if isinstance(self.footprint, tuple):
            return max(math.hypot(*corner) for corner in self.footprint)
        return float(self.footprint)

    @property
    def needed(self) -> float:
        """Minimum distance of the camera's vertical to obstacles [m]."""
        return self.radius + self.margin
