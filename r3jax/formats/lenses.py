"""Camera models with distortion: COLMAP's models and their parameters.

The parameters are COLMAP's: focal lengths and principal point [px] first, where the upper left
pixel's center lies at (0.5, 0.5) as in this package, then the distortion. r3jax's own `Camera` is
a pinhole; distortion is kept as data and never applied.
"""

import math
from dataclasses import dataclass

import numpy as np

from r3jax.geometry.cameras import Camera
from r3jax.validation.errors import ForeignFileError

_SHARED_FOCAL, _TWO_FOCALS = "f cx cy", "fx fy cx cy"
_FULL = "k1 k2 p1 p2 k3 k4"

MODELS: dict[str, tuple[int, tuple[str, ...]]] = {
    name: (number, tuple(f"{focals} {distortion}".split()))
    for number, name, focals, distortion in (
        (0, "SIMPLE_PINHOLE", _SHARED_FOCAL, ""),
        (1, "PINHOLE", _TWO_FOCALS, ""),
        (2, "SIMPLE_RADIAL", _SHARED_FOCAL, "k"),
        (3, "RADIAL", _SHARED_FOCAL, "k1 k2"),
        (4, "OPENCV", _TWO_FOCALS, "k1 k2 p1 p2"),
        (5, "OPENCV_FISHEYE", _TWO_FOCALS, "k1 k2 k3 k4"),
        (6, "FULL_OPENCV", _TWO_FOCALS, f"{_FULL} k5 k6"),
        (7, "FOV", _TWO_FOCALS, "omega"),
        (8, "SIMPLE_RADIAL_FISHEYE", _SHARED_FOCAL, "k"),
        (9, "RADIAL_FISHEYE", _SHARED_FOCAL, "k1 k2"),
        (10, "THIN_PRISM_FISHEYE", _TWO_FOCALS, f"{_FULL} sx1 sy1"),
        (
            11,
            "RAD_TAN_THIN_PRISM_FISHEYE",
            _TWO_FOCALS,
            "k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3",
        ),
        (12, "SIMPLE_DIVISION", _SHARED_FOCAL, "k"),
        (13, "DIVISION", _TWO_FOCALS, "k"),
        (14, "SIMPLE_FISHEYE", _SHARED_FOCAL, ""),
        (15, "FISHEYE", _TWO_FOCALS, ""),
        (16, "EUCM", _TWO_FOCALS, "alpha beta"),
    )
}
"""COLMAP's number of every model, and the names of its parameters in order. Its panoramic model
(17) has no focal length and is not read."""

NAMES = {number: name for name, (number, _) in MODELS.items()}
"""The name of every model, by COLMAP's number."""

_PINHOLE_WITHOUT_DISTORTION = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"),
    *("SIMPLE_DIVISION", "DIVISION"),
)
"""Models that are a pinhole where all their distortion is zero; a fisheye lens never is."""

MAX_SIDE = 1 << 16
"""Maximum width and height of images [px]."""


@dataclass(frozen=True)
class Lens:
    """A camera model with its parameters.

    Raises:
        ForeignFileError: an unknown model, the wrong number of parameters, a size or a focal
            length that no camera has, numbers that are not finite.
    """

    model: str
    """COLMAP's name of the model, such as OPENCV."""

    width: int
    """Columns [px]."""

    height: int
    """Rows [px]."""

    params: tuple[float, ...]
    """Parameters in the order of `MODELS`."""

    def __post_init__(self) -> None:
        """Refuses invalid cameras."""
        if self.model not in MODELS:
            known = ", ".join(MODELS)
            raise ForeignFileError(f"unknown camera model {self.model[:40]!r}; known: {known}")
        names = MODELS[self.model][1]
        if len(self.params) != len(names):
            raise ForeignFileError(
                f"{self.model} has the {len(names)} parameters {' '.join(names)}, "
                f"got {len(self.params)}"
            )
        if not all(math.isfinite(value) for value in self.params):
            raise ForeignFileError("the camera has parameters that are not finite")
        if not (0 < self.width <= MAX_SIDE and 0 < self.height <= MAX_SIDE):
            raise ForeignFileError(f"the camera's image is {self.width} x {self.height} pixels")
        fx, fy, cx, cy = self.intrinsics
        if min(fx, fy) < 1e-3 or max(fx, fy) > 1e9:
            raise ForeignFileError(f"invalid focal lengths {fx:g} and {fy:g} [px]")
        if max(abs(cx), abs(cy)) > 1e9:
            raise ForeignFileError(f"invalid principal point ({cx:g}, {cy:g})")

    @property
    def named(self) -> dict[str, float]:
        """All parameters by their names."""
        return dict(zip(MODELS[self.model][1], self.params, strict=True))

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy [px]."""
        if MODELS[self.model][1][0] == "f":
            f, cx, cy = self.params[:3]
            return f, f, cx, cy
        fx, fy, cx, cy = self.params[:4]
        return fx, fy, cx, cy

    @property
    def distortion(self) -> dict[str, float]:
        """The parameters after the principal point."""
        skipped = 3 if MODELS[self.model][1][0] == "f" else 4
        return dict(list(self.named.items())[skipped:])

    @property
    def is_pinhole(self) -> bool:
        """True if there is no distortion, so that `camera` is complete."""
        return self.model in _PINHOLE_WITHOUT_DISTORTION and not any(self.distortion.values())

    def has_shape(self, width: int, height: int) -> bool:
        """Checks whether images of this size may be scaled images of this lens, up to rounding."""
        off = abs(width * self.height - height * self.width)
        return min(width, height) > 0 and off <= self.width + self.height

    def resized(self, width: int, height: int) -> "Lens":
        """Scales the lens to images of another number of pixels [px]."""
        across, down = width / self.width, height / self.height
        scales = (across, across, down) if MODELS[self.model][1][0] == "f" else (
            across, down, across, down,
        )  # fmt: skip
        pixels = [value * scale for value, scale in zip(self.params, scales, strict=False)]
        return Lens(self.model, width, height, (*pixels, *self.params[len(scales) :]))

    @property
    def camera(self) -> Camera:
        """The pinhole camera of the same focal lengths, whatever the distortion."""
        return Camera(self.width, self.height, *self.intrinsics)


def matrix_lens(K: np.ndarray, size: tuple[int, int], offset: float = 0.5) -> Lens:
    """Makes the PINHOLE of a matrix of intrinsics, [3, 3] or larger.

    Args:
        K: the matrix.
        size: width and height [px].
        offset: added to the principal point: 0.5 where pixel centers lie at whole numbers.
    """
    params = (K[0, 0], K[1, 1], K[0, 2] + offset, K[1, 2] + offset)
    return Lens("PINHOLE", *size, tuple(float(value) for value in params))


def pinhole_lens(camera: Camera) -> Lens:
    """Makes the PINHOLE of a camera."""
    values = (camera.fx, camera.fy, camera.cx, camera.cy)
    return Lens("PINHOLE", camera.width, camera.height, tuple(float(value) for value in values))
