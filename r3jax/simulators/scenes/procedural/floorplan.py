"""Rooms with real walls: rectangles of free space, and openings cut between them.

A room is the free rectangle between its walls. What lies between neighboring rooms is the
wall; a shell round everything is the outer wall. Doorways and windows are boxes that cut the
faces they touch and get reveals, frames and sills. So a camera inside sees surfaces only.
"""

import itertools
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from r3jax.simulators.scenes.procedural.materials import finishes as f
from r3jax.simulators.scenes.procedural.materials.textures import Real
from r3jax.simulators.scenes.procedural.model import Finish, Model
from r3jax.simulators.scenes.procedural.shapes import Shape, box, combine, grid, quad

OUTER_WALL = 0.25
"""Thickness of the outer walls, and depth of a window [m]."""

DOOR_HEIGHT = 2.15
"""Clear height of doorways [m]."""

_CELL = 0.36  # largest cell of a wall, floor or ceiling [m]: how finely corners are shaded


_Hole = tuple[Real, Real, Real, Real]
"""An opening in a wall: from, to, bottom, top along it [m]."""


@dataclass
class Room:
    """A rectangle of free space and what its surfaces are made of."""

    x0: Real
    y0: Real
    x1: Real
    y1: Real
    wall: Finish
    floor: Finish
    ceiling: Finish
    height: Real = 2.6
    base: Real = 0.0
    """Height of the floor [m]: rooms of several stories lie in one plan."""
    cell: Real = _CELL
    """Largest cell of its surfaces [m]: how finely their corners are shaded."""
    sides: dict[str, Finish] = field(default_factory=dict[str, Finish])
    """Other finishes for single walls: "n", "e", "s", "w"."""
    wainscot: tuple[Real, Finish] | None = None
    """Height [m] and finish of the lower part of all walls."""
    skirting: Finish | None = None

    @property
    def center(self) -> tuple[Real, Real]:
        """Middle of the floor [m]."""
        return (self.x0 + self.x1) / 2, (self.y0 + self.y1) / 2


@dataclass(frozen=True)
class Opening:
    """A box cut out of the walls, axis-aligned [m]."""

    low: tuple[Real, Real, Real]
    high: tuple[Real, Real, Real]


@dataclass
class FloorPlan:
    """A floor plan under construction."""

    rooms: dict[str, Room] = field(default_factory=dict[str, Room])
    openings: list[Opening] = field(default_factory=list[Opening])
    model: Model = field(default_factory=Model)

    def room(self, name: str, rect: tuple[Real, Real, Real, Real], **surfaces: Any) -> Room:
        """Adds a room (x0, y0, x1, y1); `surfaces` are the fields of `Room`."""
        self.rooms[name] = Room(*rect, **surfaces)
        return self.rooms[name]

    def doorway(
        self,
        axis: str,
        gap: tuple[Real, Real],
        center: Real,
        width: Real = 1.2,
        height: Real = DOOR_HEIGHT,
        frame: Finish | None = None,
        floor: Finish | None = None,
        base: Real = 0.0,
    ) -> None:
        """Cuts a doorway through the wall between two rooms.

        Args:
            axis: direction one walks through it, "x" or "y".
            gap: the wall's two faces along the axis [m].
            center: middle of the doorway along the wall [m].
            width: clear width [m].
            height: clear height [m].
            frame: finish of reveal and casing; painted white if not given.
            floor: finish of the threshold; oak if not given.
            base: height of the threshold [m].
        """
        finish = frame or f.enamel(f.WHITE, 3, 0.2)
        lo, hi, top = center - width / 2, center + width / 2, base + height
        box_low, box_high = (gap[0], lo, base), (gap[1], hi, top)
        if axis == "y":
            box_low, box_high = (lo, gap[0], base), (hi, gap[1], top)
        self.openings.append(Opening(box_low, box_high))
        tunnel = _tunnel(axis, gap, (lo, hi), (base, top))
        self.model.add(tunnel[0], floor or f.wood(f.OAK, 8)).add(combine(tunnel[1:]), finish)
        casing = 0.07
        for face, out in ((gap[0], -0.018), (gap[1], 0.018)):
            a, b = sorted((face, face + out))
            for s0, s1, z0, z1 in (
                (lo - casing, lo, base, top + casing),
                (hi, hi + casing, base, top + casing),
                (lo, hi, top, top + casing),
            ):
                bar = (
                    box((a, s0, z0), (b, s1, z1)) if axis == "x" else box((s0, a, z0), (s1, b, z1))
                )
                self.model.add(bar, finish)

    def window(
        self, room: str, side: str, center: Real, width: Real, sill: Real, top: Real, view: int
    ) -> None:
        """Cuts a window into an outer wall: reveal, sill, frame, pane with the view outside.

        Args:
            room: which room.
            side: its wall, "n", "e", "s" or "w".
            center: middle of the window along the wall [m].
            width: clear width [m].
            sill: height of the lower edge above the floor [m].
            top: height of the upper edge above the floor [m].
            view: seed of the view outside.
        """
        r = self.rooms[room]
        base = r.base
        face, out = {"n": (r.y1, 1), "s": (r.y0, -1), "e": (r.x1, 1), "w": (r.x0, -1)}[side]
        axis = "y" if side in "ns" else "x"
        depth = 0.7 * OUTER_WALL
        gap = (min(face, face + out * depth), max(face, face + out * depth))
        lo, hi = center - width / 2, center + width / 2
        low, high = (gap[0], lo, base + sill), (gap[1], hi, base + top)
        if axis == "y":
            low, high = (lo, gap[0], base + sill), (hi, gap[1], base + top)
        self.openings.append(Opening(low, high))
        white = f.enamel(f.WHITE, 4, 0.3)
        self.model.add(combine(_tunnel(axis, gap, (lo, hi), (base + sill, base + top))), white)

        # The rest is built facing +y and turned to face into the room.
        pane = Model()
        pane.add(quad((width / 2, 0.0, sill), (-width, 0, 0), (0, 0, top - sill)), f.window(view))
        bars = [
            box((-width / 2, 0, sill), (width / 2, 0.05, sill + 0.05)),
            box((-width / 2, 0, top - 0.05), (width / 2, 0.05, top)),
        ]
        for x in np.linspace(-width / 2 + 0.025, width / 2 - 0.025, max(2, round(width / 0.6) + 1)):
            bars.append(box((x - 0.025, 0, sill + 0.05), (x + 0.025, 0.06, top - 0.05)))
        board = box(
            (-width / 2 - 0.06, depth - 0.01, sill - 0.04), (width / 2 + 0.06, depth + 0.07, sill)
        )
        pane.add(combine(bars), white)
        pane.add(board, f.marble((0.86, 0.85, 0.82), (0.5, 0.5, 0.5), 21))
        inward = {"n": "s", "s": "n", "e": "w", "w": "e"}[side]
        x, y = (face + out * depth, center) if axis == "x" else (center, face + out * depth)
        self.model.put(pane, x, y, base, inward)

    def build(self) -> Model:
        """Builds walls, floors, ceilings, skirtings and the outer shell, with all openings cut."""
        for room in self.rooms.values():
            self._room_surfaces(room)
        corners = np.array(
            [[(r.x0, r.y0, r.base), (r.x1, r.y1, r.base + r.height)] for r in self.rooms.values()]
        )
        low, high = corners[:, 0].min(axis=0) - OUTER_WALL, corners[:, 1].max(axis=0) + OUTER_WALL
        shell = box(tuple(low), tuple(high), upright=True, step=2.0)
        self.model.add(shell, f.concrete((0.7, 0.69, 0.66), 90))
        return self.model

    def _room_surfaces(self, r: Room) -> None:
        dx, dy = r.x1 - r.x0, r.y1 - r.y0
        top = r.base + r.height
        self.model.add(quad((r.x0, r.y0, r.base), (dx, 0, 0), (0, dy, 0), r.cell), r.floor)
        self.model.add(quad((r.x0, r.y1, top), (dx, 0, 0), (0, -dy, 0), r.cell), r.ceiling)
        for side in "nesw":
            holes = self._holes(r, side)
            finish = r.sides.get(side, r.wall)
            bottom = r.base
            if r.wainscot is not None:
                bottom, lower = r.base + r.wainscot[0], r.wainscot[1]
                self.model.add(_wall(r, side, r.base, bottom, holes), lower)
                self._rail(r, side, bottom, holes)
            self.model.add(_wall(r, side, bottom, top, holes), finish)
            if r.skirting is not None:
                self._strip(r, side, (r.base, r.base + 0.09), 0.015, holes, r.skirting)

    def _rail(self, r: Room, side: str, z: Real, holes: list[_Hole]) -> None:
        finish = r.skirting or f.enamel(f.WHITE, 3, 0.2)
        blocking = [
            (a, b, z - 1.0 if c < z + 0.02 and d > z - 0.02 else z + 9.0, d) for a, b, c, d in holes
        ]
        self._strip(r, side, (z - 0.02, z + 0.02), 0.018, blocking, finish)

    def _strip(
        self,
        r: Room,
        side: str,
        z: tuple[Real, Real],
        depth: Real,
        holes: list[_Hole],
        finish: Finish,
    ) -> None:
        """Builds a bar along a wall, interrupted by the openings that reach down to it."""
        lo, hi = (r.x0, r.x1) if side in "ns" else (r.y0, r.y1)
        # Casings stand 0.07 m beside their opening.
        cuts = sorted((a - 0.07, b + 0.07) for a, b, c, _ in holes if c < z[1])
        starts, ends = [lo] + [b for _, b in cuts], [a for a, _ in cuts] + [hi]
        for a, b in zip(starts, ends, strict=True):
            if b - a < 0.02:
                continue
            corners: dict[str, tuple[tuple[Real, Real], tuple[Real, Real]]] = {
                "n": ((a, r.y1 - depth), (b, r.y1)),
                "s": ((a, r.y0), (b, r.y0 + depth)),
                "e": ((r.x1 - depth, a), (r.x1, b)),
                "w": ((r.x0, a), (r.x0 + depth, b)),
            }
            low, high = corners[side]
            self.model.add(box((*low, z[0]), (*high, z[1])), finish)

    def _holes(self, r: Room, side: str) -> list[_Hole]:
        """Finds the openings in one wall."""
        face = {"n": r.y1, "s": r.y0, "e": r.x1, "w": r.x0}[side]
        across, along = (1, 0) if side in "ns" else (0, 1)
        lo, hi = (r.x0, r.x1) if side in "ns" else (r.y0, r.y1)
        holes: list[_Hole] = []
        for o in self.openings:
            touches = min(abs(o.low[across] - face), abs(o.high[across] - face)) < 1e-6
            touches &= o.high[2] > r.base and o.low[2] < r.base + r.height
            if touches and o.low[along] > lo - 1e-6 and o.high[along] < hi + 1e-6:
                holes.append((o.low[along], o.high[along], o.low[2], o.high[2]))
        return holes


def _wall(r: Room, side: str, z0: Real, z1: Real, holes: list[_Hole]) -> Shape:
    """Builds one wall between two heights, seen from inside, without its openings."""
    lo, hi = (r.x0, r.x1) if side in "ns" else (r.y0, r.y1)
    s = _ticks(lo, hi, [v for a, b, _, _ in holes for v in (a, b)], r.cell)
    t = _ticks(z0, z1, [v for _, _, c, d in holes for v in (c, d)], r.cell)
    origin, along = {
        "n": ((0.0, r.y1), (1.0, 0.0)),
        "s": ((0.0, r.y0), (-1.0, 0.0)),
        "e": ((r.x1, 0.0), (0.0, -1.0)),
        "w": ((r.x0, 0.0), (0.0, 1.0)),
    }[side]
    # Seen from inside, x runs to the right on the north wall and to the left on the south wall.
    s = s if along[0] + along[1] > 0 else s[::-1]
    ss, tt = np.meshgrid(s, t)
    zero = np.zeros_like(ss)
    points = np.stack(
        [ss, zero + origin[1], tt] if side in "ns" else [zero + origin[0], ss, tt], axis=-1
    )
    shape = grid(points, s if along[0] + along[1] > 0 else -s, t)
    if not holes:
        return shape
    middle = shape.corners.mean(axis=1)
    m, z = middle[:, 0 if side in "ns" else 1], middle[:, 2]
    keep = np.ones(len(middle), dtype=bool)
    for a, b, c, d in holes:
        keep &= ~((m > a) & (m < b) & (z > c) & (z < d))
    return Shape(shape.corners[keep], shape.uv[keep])


def _ticks(lo: Real, hi: Real, cuts: list[Real], cell: Real) -> np.ndarray:
    inner = [c for c in cuts if lo < c < hi]
    stops = np.unique(np.round([lo, hi, *inner], 9))
    parts = [
        np.linspace(a, b, int(np.ceil((b - a) / cell)) + 1)[:-1]
        for a, b in itertools.pairwise(stops)
    ]
    return np.concatenate([*parts, [hi]])


def _tunnel(
    axis: str, gap: tuple[Real, Real], span: tuple[Real, Real], z: tuple[Real, Real]
) -> list[Shape]:
    """Builds the four inner faces of an opening: floor, head and both jambs."""
    (g0, g1), (s0, s1), (z0, z1) = gap, span, z
    faces = [
        quad((g0, s0, z0), (g1 - g0, 0, 0), (0, s1 - s0, 0), _CELL),
        quad((g0, s1, z1), (g1 - g0, 0, 0), (0, s0 - s1, 0), _CELL),
        quad((g1, s0, z0), (g0 - g1, 0, 0), (0, 0, z1 - z0), _CELL),
        quad((g0, s1, z0), (g1 - g0, 0, 0), (0, 0, z1 - z0), _CELL),
    ]
    if axis == "y":  # (x, y) -> (y, x) mirrors: turn the triangles round again
        faces = [Shape(q.corners[:, ::-1][..., [1, 0, 2]], q.uv[:, ::-1]) for q in faces]
    return faces
