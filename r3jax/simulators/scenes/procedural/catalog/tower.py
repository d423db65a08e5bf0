"""The tower: three stories of 60 x 60 m round an atrium, over which a flying camera changes floors.

Every story has offices, classrooms, libraries, lounges and meeting rooms along a ring of
corridors. The rooms that face the atrium open onto it; two of the four do on every story.
"""

from collections.abc import Callable
from typing import Any

from r3jax.simulators.scenes.procedural.floorplan import FloorPlan
from r3jax.simulators.scenes.procedural.furniture import kitchen, objects, pieces
from r3jax.simulators.scenes.procedural.materials import finishes as f
from r3jax.simulators.scenes.procedural.materials.finishes import CHIPS, NORDIC
from r3jax.simulators.scenes.procedural.materials.textures import Real
from r3jax.simulators.scenes.procedural.model import Finish, Model, assemble
from r3jax.simulators.world import World

SUMMARY = "tower of three stories round an atrium, 72 furnished rooms, 60 x 60 m, 9900 m2"

STORIES = 3

_STORY, _HEIGHT = 3.3, 2.8
"""From floor to floor, and from floor to ceiling [m]."""

_BANDS = {
    "a": (0.0, 10.6),
    "left": (10.72, 13.3),
    "b": (13.42, 23.4),
    "c": (23.52, 36.48),
    "d": (36.6, 46.58),
    "right": (46.7, 49.28),
    "e": (49.4, 60.0),
}
"""Strips of rooms, and the two corridors between them, along both axes [m]."""

_ROOMS = "abcde"
_CELL = 1.2
_WALL = 0.12


def _kind(level: int, x: str, y: str) -> str:
    """Returns what a room is used for: neighbors differ, and stories do."""
    number = _ROOMS.index(x) + 2 * _ROOMS.index(y) + 3 * level
    return ("office", "classroom", "lounge", "library", "meeting")[number % 5]


def _name(level: int, x: str, y: str) -> str:
    return f"{level}{x}{y}"


def plan() -> FloorPlan:
    """Lays out rooms, doorways and windows."""
    drawn, ceiling = FloorPlan(), f.acoustic_ceiling(7)
    carpet = f.carpet((0.4, 0.43, 0.47), (0.58, 0.6, 0.6), 6)
    stone = f.terrazzo((0.66, 0.65, 0.62), CHIPS, 111)
    planks = f.plank_floor(f.OAK, 112, 0.25)
    floors = {"office": carpet, "classroom": planks, "lounge": planks, "library": carpet,
              "meeting": carpet}  # fmt: skip
    tints = {"office": (0.87, 0.87, 0.85), "classroom": (0.9, 0.85, 0.68),
             "lounge": (0.7, 0.78, 0.76), "library": (0.84, 0.8, 0.72),
             "meeting": (0.8, 0.82, 0.88)}  # fmt: skip
    walls = {kind: f.plaster(tint, 113 + n) for n, (kind, tint) in enumerate(tints.items())}
    white, frame = f.plaster((0.92, 0.91, 0.88), 120), f.enamel(f.CHARCOAL, 3, 0.2)
    (x0, x1), top = _BANDS["c"], STORIES * _STORY - (_STORY - _HEIGHT)
    brick = f.brick(121, (0.72, 0.6, 0.52))
    drawn.room("atrium", (x0, x0, x1, x1), wall=brick, floor=stone, ceiling=ceiling, height=top,
               cell=_CELL)  # fmt: skip
    for level in range(STORIES):
        base = level * _STORY
        surfaces = {"floor": stone, "ceiling": ceiling, "height": _HEIGHT, "base": base,
                    "cell": _CELL}  # fmt: skip
        left, right = _BANDS["left"], _BANDS["right"]
        inner = (_BANDS["b"][0], _BANDS["d"][1])
        for name, rect in (
            ("west", (left[0], 0.0, left[1], 60.0)),
            ("east", (right[0], 0.0, right[1], 60.0)),
            ("south", (inner[0], left[0], inner[1], left[1])),
            ("north", (inner[0], right[0], inner[1], right[1])),
        ):
            drawn.room(f"{level}{name}", rect, wall=white, **surfaces)
        for x in _ROOMS:
            for y in _ROOMS:
                if x == y == "c":
                    continue
                (low_x, high_x), (low_y, high_y), kind = _BANDS[x], _BANDS[y], _kind(level, x, y)
                drawn.room(_name(level, x, y), (low_x, low_y, high_x, high_y), wall=walls[kind],
                           **(surfaces | {"floor": floors[kind]}))  # fmt: skip
        _doorways(drawn, base, frame, stone)
        _windows(drawn, level)
    return drawn


def _doorways(drawn: FloorPlan, base: Real, frame: Finish, floor: Finish) -> None:
    """Cuts the doorways of one story."""
    how: dict[str, Any] = {"frame": frame, "floor": floor, "base": base}
    middle = lambda band: sum(_BANDS[band]) / 2
    left, right = _BANDS["left"], _BANDS["right"]
    # Corridors meet in wide openings.
    for y in (sum(left) / 2, sum(right) / 2):
        drawn.doorway("x", (left[1], left[1] + _WALL), y, 2.0, 2.4, **how)
        drawn.doorway("x", (right[0] - _WALL, right[0]), y, 2.0, 2.4, **how)
    for k, band in enumerate(_ROOMS):
        shift = 0.8 * (k % 3 - 1)
        # The outer strips in the west and in the east open onto the long corridors.
        drawn.doorway("x", (left[0] - _WALL, left[0]), middle(band) + shift, 1.4, **how)
        drawn.doorway("x", (right[1], right[1] + _WALL), middle(band) - shift, 1.4, **how)
    for k, band in enumerate("bcd"):
        shift = 0.8 * (k % 3 - 1)
        drawn.doorway("y", (left[0] - _WALL, left[0]), middle(band) + shift, 1.4, **how)
        drawn.doorway("y", (right[1], right[1] + _WALL), middle(band) - shift, 1.4, **how)
        drawn.doorway("y", (left[1], left[1] + _WALL), middle(band) - shift, 1.4, **how)
        drawn.doorway("y", (right[0] - _WALL, right[0]), middle(band) + shift, 1.4, **how)
    low, high = _BANDS["c"]
    # Onto the atrium, as balconies above the ground.
    for gap in ((low - _WALL, low), (high, high + _WALL)):
        drawn.doorway("x", gap, middle("c") + 2.0, 3.0, 2.4, **how)
        drawn.doorway("y", gap, middle("c") - 2.0, 3.0, 2.4, **how)
    drawn.doorway("x", (left[1], left[1] + _WALL), middle("c") - 1.0, 1.4, **how)
    drawn.doorway("x", (right[0] - _WALL, right[0]), middle("c") + 1.0, 1.4, **how)


def _windows(drawn: FloorPlan, level: int) -> None:
    for band in _ROOMS:
        center = sum(_BANDS[band]) / 2
        for side, x, y in (("s", band, "a"), ("n", band, "e"), ("w", "a", band), ("e", "e", band)):
            view = 31 + (_ROOMS.index(band) + level) % 4
            drawn.window(_name(level, x, y), side, center, 3.2, 0.9, 2.4, view)


def _office(m: Model, seed: int) -> None:
    for x in (-2.4, 2.4):
        m.put(pieces.desk_island(2, 4 + seed % 3), x, 1.2)
    m.put(pieces.filing_cabinet(seed % 3), -3.6, -3.2)
    m.put(pieces.meeting_table(1.8, 0.9, 2, seed % 2), 1.2, -2.6)
    m.put(objects.leafy_plant(1.4, 3, 24), 3.6, -3.4)


def _classroom(m: Model, seed: int) -> None:
    for row in range(3):
        for column in range(3):
            m.put(pieces.school_desk((row * 3 + column + seed) % 9), 1.9 * row - 1.4,
                  1.9 * column - 1.7, 0, 270.0)  # fmt: skip
    m.put(pieces.lectern(f.wood(f.OAK, 13)), -3.2, 0.6, 0, "e")
    m.put(pieces.globe(5), -3.4, -3.3)


def _lounge(m: Model, seed: int) -> None:
    cloth = f.fabric((f.TEAL, f.TERRACOTTA, f.NAVY)[seed % 3], 2)
    m.put(objects.rug(3.4, 2.4, NORDIC, 16 + seed % 3), 0.0, 0.0)
    m.put(pieces.sofa(2.2, cloth, (f.fabric(f.MUSTARD, 3),), seed % 3), 0.0, -1.9)
    m.put(pieces.armchair(cloth, f.fabric(f.MUSTARD, 3)), -1.7, 1.3, 0, 200.0)
    m.put(pieces.armchair(cloth, f.fabric(f.MUSTARD, 3)), 1.7, 1.3, 0, 160.0)
    m.put(pieces.coffee_table(f.wood(f.WALNUT, 11), seed % 4), 0.0, 0.2)
    front = f.enamel((0.86, 0.5, 0.28), 4, 0.3)
    m.put(kitchen.island(1.8, front, f.wood(f.BEECH, 6), 14), 3.2, 2.9)
    m.put(objects.leafy_plant(1.5, 7, 24), -3.4, 3.2)


def _library(m: Model, seed: int) -> None:
    wood = f.wood(f.OAK, 11)
    for k, y in enumerate((-2.7, 0.0, 2.7)):
        for x in (-2.0, 2.0):
            m.put(pieces.bookshelf(2.2, 1.9, wood, 51 + (k + seed) % 4), x, y + 0.02, 0, "n")
            m.put(pieces.bookshelf(2.2, 1.9, wood, 55 + (k + seed) % 4), x, y - 0.02, 0, "s")
    m.put(pieces.armchair(f.leather((0.3, 0.1, 0.1), 6), f.fabric(f.MUSTARD, 3)), 3.7, 1.4, 0, "w")


def _meeting(m: Model, seed: int) -> None:
    m.put(pieces.meeting_table(3.6, 1.4, 5, seed % 3), 0.0, 0.6)
    m.put(pieces.glass_partition(3.0, _HEIGHT), -1.0, -2.2)
    m.put(pieces.sideboard(1.5, f.wood(f.WALNUT, 11), 9), 2.6, -3.0)
    m.put(pieces.plinth_sculpture(seed % 3 + 1, f.marble((0.9, 0.89, 0.86), (0.5, 0.5, 0.5), 79)),
          3.6, 3.2)  # fmt: skip
    m.put(objects.leafy_plant(1.2, 6, 24), -3.6, 3.3)


_FURNISH: dict[str, Callable[[Model, int], None]] = {
    "office": _office, "classroom": _classroom, "lounge": _lounge, "library": _library,
    "meeting": _meeting,
}  # fmt: skip


def _furnish(m: Model, drawn: FloorPlan) -> None:
    """Puts furniture round the middle of each room, and a lamp and pictures where they are seen."""
    # Some of each kind: a room is one of them, turned.
    kinds = {(kind, n): Model() for kind in _FURNISH for n in range(3)}
    for (kind, n), model in kinds.items():
        _FURNISH[kind](model, n)
    panel = objects.ceiling_panel(_HEIGHT, 1.2, 0.6, 6.0)
    subjects = ("landscape", "abstract", "sunset", "poster")
    pictures = [objects.picture(kind, 90 + n, 1.2, 0.8, 1.7) for n, kind in enumerate(subjects)]
    for level in range(STORIES):
        for i, x in enumerate(_ROOMS):
            for j, y in enumerate(_ROOMS):
                if x == y == "c":
                    continue
                room, number = drawn.rooms[_name(level, x, y)], i + 2 * j + level
                heading = 180.0 * (number % 2)
                m.put(kinds[_kind(level, x, y), number % 3], *room.center, room.base, heading)
                m.put(panel, *room.center, room.base)
                for k, (side, px, py) in enumerate((("n", -2.9, room.y0), ("s", 2.9, room.y1))):
                    m.put(pictures[(number + k) % 4], room.center[0] + px, py, room.base, side)
        for name in ("west", "east"):
            corridor = drawn.rooms[f"{level}{name}"]
            for y in (8.0, 30.0, 52.0):
                m.put(panel, corridor.center[0], y, corridor.base)
    stone = f.marble((0.85, 0.72, 0.6), (0.5, 0.35, 0.25), 81)
    cx, cy = drawn.rooms["atrium"].center
    for k, (dx, dy) in enumerate(((-4.0, -4.0), (4.0, -4.0), (4.0, 4.0), (-4.0, 4.0))):
        m.put(pieces.plinth_sculpture(k, stone), cx + dx, cy + dy)
        m.put(objects.leafy_plant(1.5, k, 30), cx + 1.1 * dx, cy)
        m.put(pieces.bench(1.6, f.wood(f.WALNUT, 11), f.leather((0.3, 0.1, 0.1), 6)), cx, cy + dy)
    for z in (2.0, 5.0, 8.0):
        m.light((cx, cy, z), 9.0)


def build() -> World:
    """Makes the tower."""
    drawn = plan()
    m = drawn.build()
    _furnish(m, drawn)
    return assemble("tower", m, (30.0, 30.0, 1.3), 30.0, SUMMARY)
