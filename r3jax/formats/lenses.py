"""Camera models with distortion: COLMAP's models and their parameters.

The parameters are COLMAP's: focal lengths and principal point [px] first, where the upper left
pixel's center lies at (0.5, 0.5) as in this package, then the distortion. r3jax's own `Camera` is
a pinhole; distortion is kept as data, and `distorted` and `project_rays` apply it.

Shape symbols: ... any number of rays.
"""

import functools
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
        (17, "EQUIRECTANGULAR", "w h", ""),
        (-1, "DUAL_FISHEYE", "fov", ""),
    )
}
"""COLMAP's number of every model, and the names of its parameters in order. EQUIRECTANGULAR is a
panorama of the whole sphere, whose parameters are its size [px]. DUAL_FISHEYE is no model of
COLMAP's: two equidistant circles side by side, the camera's front in the left one and its back in
the right one, each of `fov` degrees across the height of the image."""

PANORAMA, DUAL_FISHEYE = "EQUIRECTANGULAR", "DUAL_FISHEYE"
"""Models of photos that show all directions."""

NAMES = {number: name for name, (number, _) in MODELS.items() if number >= 0}
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
        if self.is_panorama:
            self._check_panorama()
        fx, fy, cx, cy = self.intrinsics
        if min(fx, fy) < 1e-3 or max(fx, fy) > 1e9:
            raise ForeignFileError(f"invalid focal lengths {fx:g} and {fy:g} [px]")
        if max(abs(cx), abs(cy)) > 1e9:
            raise ForeignFileError(f"invalid principal point ({cx:g}, {cy:g})")

    def _check_panorama(self) -> None:
        if self.model == DUAL_FISHEYE and not 180.0 <= self.params[0] <= 300.0:
            raise ForeignFileError(
                f"each circle of a dual fisheye shows 180 to 300 degrees (`fov`), got "
                f"{self.params[0]:g}"
            )
        if self.model == PANORAMA and self.params != (self.width, self.height):
            raise ForeignFileError(
                f"the panorama has {self.width} x {self.height} pixels, but its parameters w h are "
                f"{self.params[0]:g} {self.params[1]:g}"
            )
        if not 0.99 < self.width / (2.0 * self.height) < 1.01:
            raise ForeignFileError(
                f"a 360 photo is twice as wide as high, this one has {self.width} x {self.height} "
                "pixels: export the whole panorama, without a crop"
            )

    @property
    def is_panorama(self) -> bool:
        """True if the image shows all directions."""
        return self.model in (PANORAMA, DUAL_FISHEYE)

    @property
    def named(self) -> dict[str, float]:
        """All parameters by their names."""
        return dict(zip(MODELS[self.model][1], self.params, strict=True))

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy [px]; where all directions are shown, pixels per radian and the middle."""
        if self.is_panorama:
            w, h = self.width, self.height
            if self.model == DUAL_FISHEYE:
                f = h / math.radians(self.params[0])
                return f, f, 0.5 * w, 0.5 * h
            return 0.5 * w / math.pi, h / math.pi, 0.5 * w, 0.5 * h
        if MODELS[self.model][1][0] == "f":
            f, cx, cy = self.params[:3]
            return f, f, cx, cy
        fx, fy, cx, cy = self.params[:4]
        return fx, fy, cx, cy

    @property
    def distortion(self) -> dict[str, float]:
        """The parameters after the principal point."""
        if self.is_panorama:
            return {}
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
        if self.is_panorama:
            size = (float(width), float(height))
            return Lens(self.model, width, height, size if self.model == PANORAMA else self.params)
        across, down = width / self.width, height / self.height
        scales = (across, across, down) if MODELS[self.model][1][0] == "f" else (
            across, down, across, down,
        )  # fmt: skip
        pixels = [value * scale for value, scale in zip(self.params, scales, strict=False)]
        return Lens(self.model, width, height, (*pixels, *self.params[len(scales) :]))

    @functools.cached_property
    def half_angle(self) -> float:
        """Largest angle to the axis that a fisheye shows along its longer side [rad].

        The image circle is as wide as the longer side of the image, and the polynomial of the
        distortion holds up to where it turns back. Of other lenses it is below a right angle, and
        of a panorama it is pi.
        """
        if self.is_panorama:
            return math.pi
        side = max(self.width, self.height)
        fx = self.intrinsics[0]
        if self.model not in BEYOND_A_HALF:
            return math.atan(0.5 * side / fx)
        angle = np.linspace(0.0, math.pi, _ANGLES)
        radius = distorted(self, np.sin(angle), np.zeros(_ANGLES), np.cos(angle))[0]
        is_shown = (np.diff(radius, prepend=-1.0) > 0.0) & (fx * radius <= 0.5 * side)
        return float(angle[np.argmin(is_shown) - 1] if not is_shown.all() else math.pi)

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


_RADIAL = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
_FISHEYE = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_FISHEYE",
            "FISHEYE")  # fmt: skip
_DIVISION = ("SIMPLE_DIVISION", "DIVISION")

BEYOND_A_HALF = (*_FISHEYE, "THIN_PRISM_FISHEYE")
"""Models that can show more than a half sphere."""

_ANGLES = 1801
"""Angles from 0 to 180 degrees at which a fisheye is evaluated."""


def distorted(
    lens: Lens, x: np.ndarray, y: np.ndarray, z: np.ndarray | float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Distorts the ray (x, y, z): the normalized coordinates at which the lens shows it.

    The models are COLMAP's: a polynomial in the squared radius and a tangential part (Brown), or
    in the angle to the axis (fisheye).

    Args:
        lens: the lens.
        x: rays to the right, [...].
        y: rays downwards, [...].
        z: rays along the axis, [...]; only fisheyes show those that are not positive.

    Raises:
        ForeignFileError: another model.
    """
    k = {"k1": lens.named.get("k", 0.0), **lens.named}
    value = lambda name: k.get(name, 0.0)
    if lens.model in BEYOND_A_HALF:
        radius = np.hypot(x, y)
        angle = np.arctan2(radius, z)
        scale = np.where(radius > 1e-9, angle / np.maximum(radius, 1e-9), 1.0)
        x, y = x * scale, y * scale
        t = x * x + y * y
        bent = t * (value("k1") + t * (value("k2") + t * (value("k3") + t * value("k4"))))
        if lens.model in _FISHEYE:
            return x * (1.0 + bent), y * (1.0 + bent)
        p1, p2 = value("p1"), value("p2")
        return (
            x + x * bent + 2.0 * p1 * x * y + p2 * (t + 2.0 * x * x) + value("sx1") * t,
            y + y * bent + 2.0 * p2 * x * y + p1 * (t + 2.0 * y * y) + value("sy1") * t,
        )
    x, y = x / z, y / z
    squared = x * x + y * y
    if lens.model == "FOV":
        radius, omega = np.sqrt(squared), max(abs(value("omega")), 1e-6)
        bent = np.arctan(2.0 * radius * np.tan(0.5 * omega)) / omega
        factor = np.where(radius > 1e-9, bent / np.maximum(radius, 1e-9), 1.0)
        return x * factor, y * factor
    if lens.model == "EUCM":
        alpha = value("alpha")
        depth = alpha * np.sqrt(value("beta") * squared + 1.0) + 1.0 - alpha
        return x / depth, y / depth
    if lens.model in _DIVISION:
        # r = bent / (1 + k bent^2), solved for what the lens shows.
        under = np.maximum(1.0 - 4.0 * value("k1") * squared, 0.0)
        factor = 2.0 / (1.0 + np.sqrt(under))
        return x * factor, y * factor
    if lens.model not in _RADIAL:
        raise ForeignFileError(
            f"images of a {lens.model} lens cannot be undistorted here: undistort the capture "
            "first, for example by COLMAP's image_undistorter"
        )
    upper = 1.0 + squared * (value("k1") + squared * (value("k2") + squared * value("k3")))
    lower = 1.0 + squared * (value("k4") + squared * (value("k5") + squared * value("k6")))
    factor = upper / np.where(np.abs(lower) > 1e-9, lower, 1.0)
    p1, p2 = value("p1"), value("p2")
    return (
        x * factor + 2.0 * p1 * x * y + p2 * (squared + 2.0 * x * x),
        y * factor + 2.0 * p2 * x * y + p1 * (squared + 2.0 * y * y),
    )


def project_rays(lens: Lens, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Projects rays of any direction into the image of a panorama, fisheye or dual fisheye.

    Args:
        lens: of a panorama (COLMAP's and nerfstudio's: the axis is in the middle of the image,
            right of it is right), or a fisheye.
        rays: directions in the camera's axes, of any length, [..., 3].

    Returns:
        Columns and rows [px], [...]; NaN beyond the lens' field of view.

    Raises:
        ForeignFileError: a lens that does not show more than a half sphere.
    """
    x, y, z = np.moveaxis(rays, -1, 0)
    fx, fy, cx, cy = lens.intrinsics
    if lens.model == DUAL_FISHEYE:
        is_front = z >= 0.0
        side, radius = np.where(is_front, x, -x), np.hypot(x, y)
        scale = fx * np.arctan2(radius, np.abs(z)) / np.maximum(radius, 1e-9)
        return 0.5 * lens.height + np.where(
            is_front, 0.0, lens.height
        ) + scale * side, cy + scale * y
    if lens.is_panorama:
        column = cx + fx * np.arctan2(x, z)
        return column % lens.width, cy + fy * np.arctan2(y, np.hypot(x, z))
    bent_x, bent_y = distorted(lens, x, y, z)
    is_seen = np.arctan2(np.hypot(x, y), z) <= lens.half_angle
    return np.where(is_seen, fx * bent_x + cx, np.nan), np.where(is_seen, fy * bent_y + cy, np.nan)
