"""Furniture as data: shapes with finishes, placed and combined, and the world that is made of it.

Local frame of a piece of furniture: z up from the floor, its back along y = 0, its front
towards +y, x = 0 in its middle. Free-standing pieces (tables, chairs) have the origin in the
middle. All lengths in meters.

A world numbers the materials and stacks the triangles. The ray caster's lamps throw no shadows, so
what makes things stand *on* a floor is baked in: ambient occlusion per triangle corner, from a
blurred voxel image of the whole scene.

Shape symbols: F triangles; X Y Z voxels.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage

from r3jax.simulators.scenes.procedural.materials.textures import Color, Real
from r3jax.simulators.scenes.procedural.shapes import Shape, rotation
from r3jax.simulators.world import Lamp, Material, World

HEADINGS = {"n": 0.0, "w": 90.0, "s": 180.0, "e": 270.0}
"""Turn [deg] about z that makes a piece face north (+y), west (-x), south, east."""


@dataclass(frozen=True, eq=False)
class Finish:
    """A material and the size of its texture. Compared by identity: make each one once."""

    material: Material

    tile: tuple[Real, Real] | None = None
    """Width and height that the texture covers [m]; None: it is fitted to each shape once."""


@dataclass(frozen=True)
class Piece:
    """Triangles in one finish, with texture coordinates in texture units."""

    corners: np.ndarray
    uv: np.ndarray
    finish: Finish
    tint: tuple[Real, Real, Real]


@dataclass
class Model:
    """A collection of pieces and lamps that is placed as one."""

    pieces: list[Piece] = field(default_factory=list[Piece])
    lamps: list[Lamp] = field(default_factory=list[Lamp])

    def add(
        self,
        shape: Shape,
        finish: Finish,
        tint: tuple[Real, Real, Real] = (1.0, 1.0, 1.0),
        atlas: bool = False,
    ) -> "Model":
        """Adds a shape in a finish.

        Args:
            shape: the triangles.
            finish: what covers them.
            tint: multiplies the color, each in [0, 1].
            atlas: the shape's coordinates are texture units already.

        Returns:
            The model itself, so that calls chain.
        """
        if atlas:
            uv = shape.uv
        elif finish.tile is None:
            low, high = shape.uv.min(axis=(0, 1)), shape.uv.max(axis=(0, 1))
            uv = (shape.uv - low) / np.maximum(high - low, 1e-9)
        else:
            # Another place of the texture for each part: copies do not look copied.
            shift = 0.754877666 * (1 + len(self.pieces)) * np.array([1.0, 0.569840291])
            uv = shape.uv / np.asarray(finish.tile) + shift % 1.0
        self.pieces.append(Piece(shape.corners, uv, finish, tint))
        return self

    def light(
        self, at: tuple[Real, Real, Real], reach: Real = 2.5, color: Color | None = None
    ) -> "Model":
        """Adds a lamp at a place in the model's frame; returns the model."""
        self.lamps.append(Lamp(at, color or (1.0, 0.9, 0.75), reach))
        return self

    def put(
        self,
        other: "Model",
        x: Real = 0.0,
        y: Real = 0.0,
        z: Real = 0.0,
        heading: str | Real = 0.0,
    ) -> "Model":
        """Places another model in this one.

        Args:
            other: the model; it is not changed.
            x: where its origin comes to lie [m].
            y: the same along y.
            z: the same along z.
            heading: direction that its front faces: "n", "e", "s", "w", or a turn from north
                about z, counter-clockwise [deg].

        Returns:
            The model itself, so that calls chain.
        """
        degrees = HEADINGS[heading] if isinstance(heading, str) else heading
        turn, shift = rotation(degrees).T, np.array([x, y, z])
        for piece in other.pieces:
            corners = piece.corners @ turn + shift
            self.pieces.append(Piece(corners, piece.uv, piece.finish, piece.tint))
        for lamp in other.lamps:
            px, py, pz = (float(c) for c in np.asarray(lamp.position) @ turn + shift)
            self.lamps.append(Lamp((px, py, pz), lamp.color, lamp.reach))
        return self


_VOXEL = 0.1  # [m]


def assemble(
    name: str,
    model: Model,
    start: tuple[Real, Real, Real],
    yaw_deg: Real,
    description: str,
    ambient: Real = 0.78,
) -> World:
    """Makes the world of a furnished model.

    Args:
        name: the scene's name.
        model: walls, furniture and lamps.
        start: camera center at the start [m].
        yaw_deg: its heading from the x axis [deg].
        description: one sentence for lists.
        ambient: share of the color that shows without lamps.
    """
    numbers: dict[int, int] = {}
    materials: list[Material] = []

    def number(finish: Finish) -> int:
        if id(finish) not in numbers:
            numbers[id(finish)] = len(materials)
            materials.append(finish.material)
        return numbers[id(finish)]

    counts = [len(p.corners) for p in model.pieces]
    corners = np.concatenate([p.corners for p in model.pieces])
    face_material = np.repeat([number(p.finish) for p in model.pieces], counts)
    uv = np.concatenate([p.uv for p in model.pieces])
    tint = np.repeat(np.array([p.tint for p in model.pieces]), counts, axis=0)
    light = ambient_occlusion(corners)
    glows = np.array([m.emission for m in materials])[face_material]
    light = np.maximum(light, glows[:, None])
    face_color = np.clip(tint[:, None, :] * light[..., None], 0.0, 1.0)
    # Vertices are rounded to 1 um: the same bytes whatever order the sums were made in.
    vertices = np.round(corners.reshape(-1, 3), 6)
    return World(
        name=name,
        vertices=vertices,
        faces=np.arange(len(vertices), dtype=np.int32).reshape(-1, 3),
        materials=tuple(materials),
        face_material=face_material.astype(np.int32),
        face_uv=uv.astype(np.float32),
        face_color=np.round(face_color, 3).astype(np.float32),
        lamps=_rounded(model.lamps),
        ambient=ambient,
        start_position=np.array(start, dtype=np.float64),
        start_yaw=math.radians(yaw_deg),
        notes={"source": "r3jax.simulators.scenes.procedural", "description": description},
    )


def _rounded(lamps: list[Lamp]) -> tuple[Lamp, ...]:
    out: list[Lamp] = []
    for lamp in lamps:
        x, y, z = (round(c, 6) for c in lamp.position)
        out.append(Lamp((x, y, z), lamp.color, lamp.reach))
    return tuple(out)


def ambient_occlusion(corners: np.ndarray) -> np.ndarray:
    """Estimates how much of the surroundings each corner sees.

    The scene's surfaces are splatted into voxels and blurred at two scales; a corner looks up
    the density a little in front of its face.

    Args:
        corners: [F, 3, 3] [m].

    Returns:
        [F, 3], from 0.4 (deep in a corner) to 1 (open).
    """
    origin = corners.min(axis=(0, 1)) - 3 * _VOXEL
    filled = surface_voxels(corners, origin, _VOXEL).astype(np.float32)
    edge_a, edge_b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(edge_a, edge_b)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    middle = corners.mean(axis=1, keepdims=True)
    light = np.ones(corners.shape[:2])
    # A lone wall fills `open_share` of the blurred ball in front of it; more is occlusion.
    for sigma, offset, open_share, strength in ((1.2, 0.12, 0.24, 0.28), (3.5, 0.3, 0.15, 0.6)):
        density = ndimage.gaussian_filter(filled, sigma, mode="nearest")
        inward = 0.9 * corners + 0.1 * middle
        at = (inward + offset * normal[:, None] - origin) / _VOXEL - 0.5
        here = ndimage.map_coordinates(density, at.reshape(-1, 3).T, order=1, mode="nearest")
        excess = np.maximum(here.reshape(light.shape) - open_share, 0.0)
        light *= np.exp(-strength * excess / 0.25)
    return np.clip(light, 0.4, 1.0)


def surface_voxels(corners: np.ndarray, origin: np.ndarray, voxel: float) -> np.ndarray:
    """Marks the voxels that any surface touches, [X, Y, Z] bool.

    Args:
        corners: of triangles, [F, 3, 3] [m].
        origin: lower corner of voxel (0, 0, 0), below all of them [3] [m].
        voxel: edge of a voxel [m].
    """
    size = np.ceil((corners.max(axis=(0, 1)) - origin) / voxel).astype(int) + 4
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.linalg.norm(normal, axis=1)
    counts = np.ceil(4.0 * area / voxel**2).astype(int)
    scaled = ((corners - origin) / voxel).astype(np.float32)
    start, edges = scaled[:, 0], scaled[:, 1:] - scaled[:, :1]
    filled = np.zeros(tuple(size), dtype=bool)
    # A million points at a time: a tower has 20 million.
    for faces in np.split(np.arange(len(corners)), _cuts(counts, 1 << 20)):
        num = counts[faces]
        face = np.repeat(faces, num)
        k = np.arange(len(face)) - np.repeat(np.cumsum(num) - num, num)
        # The R2 sequence spreads the points of each triangle evenly; fold the square in two.
        a, b = (0.5 + 0.7548776662466927 * k) % 1.0, (0.5 + 0.5698402909980532 * k) % 1.0
        outside = a + b > 1.0
        a, b = np.where(outside, 1.0 - a, a), np.where(outside, 1.0 - b, b)
        points = start[face] + a[:, None] * edges[face, 0] + b[:, None] * edges[face, 1]
        x, y, z = points.astype(int).T
        filled[x, y, z] = True
    return filled


def _cuts(counts: np.ndarray, most: int) -> np.ndarray:
    """Finds where to cut a list so that the counts of each part sum to about `most`."""
    part = np.cumsum(counts) // most
    return np.flatnonzero(np.diff(part)) + 1
