"""Furniture as data: shapes with finishes, placed and combined.

Local frame of a piece of furniture: z up from the floor, its back along y = 0, its front
towards +y, x = 0 in its middle. Free-standing pieces (tables, chairs) have the origin in the
middle. All lengths in meters.
"""

from dataclasses import dataclass, field

import numpy as np

from r3jax.simulators.scenes.procedural.materials.random_fields import Real
from r3jax.simulators.scenes.procedural.materials.textures import Color
from r3jax.simulators.scenes.procedural.shapes import Shape, rotation
from r3jax.simulators.world import Lamp, Material

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
