"""Triangle shapes with texture coordinates in meters.

A shape is a soup of triangles wound counter-clockwise seen from outside. Texture coordinates
are meters along the surface, so that every object has the same texel density; a finish turns
them into texture units. z is up; v grows upwards on upright faces.

Shape symbols: F triangles; n points.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from r3jax.errors import InputError
from r3jax.simulators.scenes.procedural.materials.textures import Real

_UNIT_QUAD = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]], dtype=np.float64)

Point = tuple[Real, Real, Real]


@dataclass(frozen=True)
class Shape:
    """Triangles without a finish."""

    corners: np.ndarray
    """[F, 3, 3] float64 [m]."""

    uv: np.ndarray
    """[F, 3, 2] float64 [m] (or texture units, for shapes made from an atlas)."""

    def __add__(self, other: "Shape") -> "Shape":
        """Joins both shapes in one."""
        return Shape(
            np.concatenate([self.corners, other.corners]), np.concatenate([self.uv, other.uv])
        )

    def moved(self, x: Real = 0.0, y: Real = 0.0, z: Real = 0.0) -> "Shape":
        """Shifts the shape by (x, y, z) [m]."""
        return Shape(self.corners + np.array([x, y, z]), self.uv)

    def turned(self, degrees: Real, axis: str = "z") -> "Shape":
        """Turns the shape about a coordinate axis through the origin [deg], right-handed."""
        return Shape(self.corners @ rotation(degrees, axis).T, self.uv)


def rotation(degrees: Real, axis: str = "z") -> np.ndarray:
    """Makes a right-handed rotation about x, y or z, [3, 3]."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.eye(3)
    matrix[i, i], matrix[i, j], matrix[j, i], matrix[j, j] = c, -s, s, c
    return matrix


def combine(shapes: list[Shape]) -> Shape:
    """Joins several shapes in one."""
    return Shape(
        np.concatenate([s.corners for s in shapes]), np.concatenate([s.uv for s in shapes])
    )


def grid(points: np.ndarray, u: np.ndarray, v: np.ndarray) -> Shape:
    """Makes a surface from a grid of points; its front is on the side of d/dcolumn x d/drow.

    Args:
        points: [rows, columns, 3].
        u: meters along the columns, [columns] or [rows, columns].
        v: meters along the rows, [rows] or [rows, columns].
    """
    rows, columns = points.shape[:2]
    uu = np.broadcast_to(u if u.ndim == 2 else u[None, :], (rows, columns))
    vv = np.broadcast_to(v if v.ndim == 2 else v[:, None], (rows, columns))
    packed = np.concatenate([points, uu[..., None], vv[..., None]], axis=-1)
    a, b = packed[:-1, :-1], packed[:-1, 1:]
    c, d = packed[1:, 1:], packed[1:, :-1]
    lower, upper = np.stack([a, b, c], axis=-2), np.stack([a, c, d], axis=-2)
    faces = np.concatenate([lower.reshape(-1, 3, 5), upper.reshape(-1, 3, 5)])
    edges = faces[:, 1:, :3] - faces[:, :1, :3]
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    faces = faces[area > 1e-9]  # poles of lathes collapse to points
    return Shape(faces[..., :3].copy(), faces[..., 3:].copy())


def quad(origin: Point, across: Point, up: Point, step: Real = 10.0) -> Shape:
    """Makes a rectangle from a corner and two edges; front on the side of across x up.

    It is cut into cells of at most `step` [m], for shading that varies over it.
    """
    o, a, b = (np.asarray(p, dtype=np.float64) for p in (origin, across, up))
    width, height = math.sqrt(a @ a), math.sqrt(b @ b)
    columns, rows = math.ceil(width / step), math.ceil(height / step)
    if columns == rows == 1:  # by far the most frequent case, and many times faster
        corners = o + np.stack([0 * a, a, a + b, 0 * a, a + b, b]).reshape(2, 3, 3)
        return Shape(corners, np.array([width, height]) * _UNIT_QUAD)
    s, t = np.linspace(0.0, 1.0, columns + 1), np.linspace(0.0, 1.0, rows + 1)
    points = o + t[:, None, None] * b + s[None, :, None] * a
    return grid(points, s * width, t * height)


def box(low: Point, high: Point, upright: bool = False, step: Real = 10.0) -> Shape:
    """Makes an axis-aligned box.

    Args:
        low: lower corner [m].
        high: upper corner [m].
        upright: texture rows stay level on the sides. Otherwise they follow the longer edge
            of each face, as the grain of a board does.
        step: largest cell of a face [m].
    """
    (x0, y0, z0), (x1, y1, z1) = low, high
    dx, dy, dz = x1 - x0, y1 - y0, z1 - z0
    if min(dx, dy, dz) <= 0.0:
        raise InputError(f"a box needs positive edges, got {(dx, dy, dz)} from {low} to {high}")
    faces = (
        quad((x0, y0, z0), (dx, 0, 0), (0, 0, dz), step),
        quad((x1, y0, z0), (0, dy, 0), (0, 0, dz), step),
        quad((x1, y1, z0), (-dx, 0, 0), (0, 0, dz), step),
        quad((x0, y1, z0), (0, -dy, 0), (0, 0, dz), step),
        quad((x0, y0, z1), (dx, 0, 0), (0, dy, 0), step),
        quad((x0, y1, z0), (dx, 0, 0), (0, -dy, 0), step),
    )
    return combine([f if upright else _along_grain(f) for f in faces])


def _along_grain(face: Shape) -> Shape:
    extent = face.uv.max(axis=(0, 1))
    return Shape(face.corners, face.uv[..., ::-1]) if extent[1] > extent[0] else face


def panel(x: Real, z: Real, width: Real, height: Real, y: Real = 0.0) -> Shape:
    """Makes an upright rectangle whose front faces +y, lower corner nearest +x; [m].

    It spans x - width / 2 .. x + width / 2 and z .. z + height.
    """
    return quad((x + width / 2, y, z), (-width, 0, 0), (0, 0, height))


def disc(radius: Real, y: Real = 0.0, segments: int = 24) -> Shape:
    """Makes an upright disc about the origin whose front faces +y; flat coordinates [m]."""
    angle = np.linspace(0.0, 2.0 * np.pi, segments + 1)
    angle[-1] = 0.0
    rim = radius * np.stack([-np.cos(angle), np.sin(angle)], axis=-1)
    flat = np.stack([np.zeros((segments, 2)), rim[:-1], rim[1:]], axis=1)
    corners = np.stack([flat[..., 0], np.full((segments, 3), y), flat[..., 1]], axis=-1)
    return Shape(corners, np.stack([radius - flat[..., 0], radius + flat[..., 1]], axis=-1))


def lathe(profile: list[tuple[Real, Real]], segments: int = 14) -> Shape:
    """Makes a solid of revolution about z.

    Args:
        profile: (radius, height) pairs from bottom to top [m].
        segments: corners of its cross-section.
    """
    radius, height = np.array(profile, dtype=np.float64).T
    angle = np.linspace(0.0, 2.0 * np.pi, segments + 1)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    ring[-1] = ring[0]
    xy = radius[:, None, None] * ring
    points = np.concatenate([xy, np.broadcast_to(height[:, None, None], (*xy.shape[:2], 1))], -1)
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(radius), np.diff(height)))])
    return grid(points, angle * max(float(radius.max()), 1e-3), arc)


def cylinder(radius: Real, z0: Real, z1: Real, segments: int = 12, top: Real = -1.0) -> Shape:
    """Makes a closed upright cylinder, or a cone when `top` gives another radius there [m]."""
    end = radius if top < 0 else top
    return lathe([(0.0, z0), (radius, z0), (end, z1), (0.0, z1)], segments)


def ball(radii: Point, segments: int = 12, rings: int = 7, power: Real = 1.0) -> Shape:
    """Makes an ellipsoid about the origin; `power` < 1 makes it boxy, as a cushion is.

    x = a sgn(c) |c|^power with c the unit sphere's coordinate (a superellipsoid).
    """
    theta = np.linspace(-np.pi / 2, np.pi / 2, rings + 1)
    phi = np.linspace(0.0, 2.0 * np.pi, segments + 1)
    soften: Callable[[np.ndarray], np.ndarray] = lambda c: np.sign(c) * np.abs(c) ** power
    cos_t, sin_t = soften(np.cos(theta)), soften(np.sin(theta))
    cos_t[[0, -1]], sin_t[[0, -1]] = 0.0, (-1.0, 1.0)
    cos_p, sin_p = soften(np.cos(phi)), soften(np.sin(phi))
    cos_p[-1], sin_p[-1] = cos_p[0], sin_p[0]
    a, b, c = radii
    points = np.stack(
        [
            a * cos_t[:, None] * cos_p[None],
            b * cos_t[:, None] * sin_p[None],
            np.broadcast_to(c * sin_t[:, None], (rings + 1, segments + 1)),
        ],
        axis=-1,
    )
    return grid(points, phi * (a + b) / 2, (theta + np.pi / 2) * (c + min(a, b)) / 2)


def cushion(low: Point, high: Point, power: Real = 0.42) -> Shape:
    """Makes a soft block that fills a box: upholstery, pillows, mattresses.

    Its texture is laid on from the six sides, as cloth is, not from the poles.
    """
    lo, hi = np.asarray(low), np.asarray(high)
    a, b, c = (float(x) for x in (hi - lo) / 2)
    corners = ball((a, b, c), 14, 8, power).corners
    normal = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    axes = np.array([[1, 2], [0, 2], [0, 1]])[np.argmax(normal, axis=1)]
    uv = np.take_along_axis(corners, np.repeat(axes[:, None], 3, axis=1), axis=2)
    return Shape(corners + (hi + lo) / 2, uv + np.array([0.37, 0.21]))


def tube(points: list[Point], radius: Real, segments: int = 5) -> Shape:
    """Makes a round bar along a polyline, without caps [m]."""
    path = np.array(points, dtype=np.float64)
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    # Any fixed direction away from the path serves as reference for its cross-sections.
    helper = np.eye(3)[int(np.argmin(np.abs(tangent).max(axis=0)))]
    side = np.cross(tangent, helper)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(tangent, side)
    angle = np.linspace(0.0, 2.0 * np.pi, segments + 1)
    ring = (
        np.cos(angle)[None, :, None] * side[:, None] + np.sin(angle)[None, :, None] * other[:, None]
    )
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    return grid(path[:, None] + radius * ring, angle * radius, length)


def curtain(width: Real, z0: Real, z1: Real, folds: int, depth: Real = 0.05) -> Shape:
    """Makes a hanging cloth in folds along x, about y = 0, front towards +y [m]."""
    s = np.linspace(0.0, 1.0, 8 * folds + 1)
    t = np.linspace(0.0, 1.0, 5)
    swing = depth * np.sin(2 * np.pi * folds * s)[None] * (0.6 + 0.4 * (1 - t))[:, None]
    sway = 0.3 * depth * np.sin(5.1 * s + 1.0)[None] * (1 - t)[:, None]
    x = np.broadcast_to(width * (0.5 - s), swing.shape)
    z = np.broadcast_to((z0 + (z1 - z0) * t)[:, None], swing.shape)
    # Cloth in folds is longer than the rail it hangs from.
    return grid(np.stack([x, swing + sway, z], axis=-1), s * width * 1.6, t * (z1 - z0))


def drape(low: Point, high: Point, hang: Real, ripple: Real = 0.015) -> Shape:
    """Makes a cloth that covers the top of a box and hangs over three sides (not y = low) [m]."""
    (x0, y0, _), (x1, y1, top) = low, high
    width = x1 - x0
    across = np.linspace(-hang, width + hang, 25)
    along = np.linspace(0.0, y1 - y0 + hang, 21)
    drop_x = np.clip(-across, 0, None) + np.clip(across - width, 0, None)
    drop_y = np.clip(along - (y1 - y0), 0, None)
    x = x0 + np.clip(across, -0.02, width + 0.02)
    y = y0 + np.clip(along, 0, y1 - y0 + 0.02)
    xx, yy = np.meshgrid(x, y)
    fall = np.maximum(drop_x[None, :], drop_y[:, None])
    wave = ripple * np.sin(17.0 * across)[None, :] * np.cos(13.0 * along)[:, None]
    zz = top - fall + np.where(fall > 0, 0.0, np.abs(wave)) + 0.012
    xx = xx + np.where(drop_x[None, :] > 0, wave, 0.0)
    yy = yy + np.where(drop_y[:, None] > 0, wave, 0.0)
    return grid(np.stack([xx, yy, zz], axis=-1), across + hang, along)
