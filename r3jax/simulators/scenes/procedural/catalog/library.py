"""The library: a reading hall with shelves, a study and a foyer."""

from r3jax.simulators.scenes.procedural.floorplan import FloorPlan
from r3jax.simulators.scenes.procedural.furniture import objects, pieces
from r3jax.simulators.scenes.procedural.materials import finishes as f
from r3jax.simulators.scenes.procedural.materials.finishes import NORDIC, PERSIAN
from r3jax.simulators.scenes.procedural.model import Model, assemble
from r3jax.simulators.world import World

SUMMARY = "library with a reading hall, a study and a foyer, 98 m2"


def plan() -> FloorPlan:
    """Lays out rooms, doorways and windows."""
    drawn, dark = FloorPlan(), f.enamel((0.3, 0.21, 0.15), 3, 0.3)
    ceiling = f.plaster((0.92, 0.9, 0.85), 111)
    drawn.room(
        "hall",
        (0, 0, 9.6, 7.6),
        wall=f.plaster((0.56, 0.62, 0.54), 112),
        floor=f.parquet_floor((0.56, 0.37, 0.22), 113, 0.4),
        ceiling=ceiling,
        height=3.0,
        wainscot=(0.95, f.wood(f.WALNUT, 14)),
        skirting=dark,
    )
    gold = ((0.4, 0.42, 0.34), (0.62, 0.52, 0.3))
    drawn.room(
        "study",
        (9.72, 0, 12.8, 3.6),
        wall=f.wallpaper((0.25, 0.3, 0.27), gold, "trellis", 24),
        floor=f.plank_floor(f.WALNUT, 114, 0.3),
        ceiling=ceiling,
        skirting=dark,
        height=2.7,
    )
    checks = f.marble((0.86, 0.84, 0.8), (0.4, 0.38, 0.36), 115, 0.14)
    drawn.room(
        "foyer",
        (9.72, 3.72, 12.8, 7.6),
        wall=f.plaster((0.84, 0.76, 0.62), 116),
        floor=checks,
        ceiling=ceiling,
        skirting=dark,
        height=2.7,
    )
    wood = f.wood(f.WALNUT, 14)
    drawn.doorway("x", (9.6, 9.72), 5.6, 1.6, 2.3, wood)
    drawn.doorway("x", (9.6, 9.72), 1.0, 1.2, 2.15, wood)
    drawn.doorway("y", (3.6, 3.72), 11.9, 1.2, 2.15, wood)
    for center, view in ((2.0, 71), (5.0, 72)):
        drawn.window("hall", "n", center, 1.6, 1.0, 2.6, view)
    drawn.window("study", "e", 1.7, 1.4, 0.9, 2.2, 73)
    drawn.window("foyer", "n", 11.2, 1.4, 0.9, 2.2, 74)
    return drawn


def _hall(m: Model) -> None:
    wood = f.wood(f.WALNUT, 14)
    for k, x in enumerate((1.5, 3.6, 5.7)):
        m.put(pieces.library_shelf(2.4, 2.0, wood, 200 + 4 * k, 1.25), x, 1.95, 0, 90.0)
    for k, y in enumerate((1.2, 3.4)):
        m.put(pieces.bookshelf(1.8, 2.4, wood, 220 + k), 0.0, y, 0, "e")
    m.put(pieces.bookshelf(2.0, 2.4, wood, 224), 8.2, 7.6, 0, "s")
    m.put(pieces.bookshelf(1.8, 2.4, wood, 226), 9.6, 2.9, 0, "w")
    for k, x in enumerate((2.2, 5.2)):
        m.put(pieces.table(1.8, 0.9, f.wood(f.OAK, 14)), x, 5.7)
        for dx, dy, turn in (
            (-0.45, -0.6, 8.0),
            (0.4, -0.65, -6.0),
            (-0.4, 0.62, 174.0),
            (0.45, 0.66, 190.0),
        ):
            m.put(pieces.chair(wood, f.leather((0.24, 0.35, 0.28), 11)), x + dx, 5.7 + dy, 0, turn)
        m.put(objects.table_lamp(2 + k, 0.42), x, 5.7, 0.74)
        m.put(objects.book_pile(4, 30 + k), x - 0.55, 5.65, 0.74, 20.0)
        m.put(objects.book_pile(3, 40 + k), x + 0.5, 5.85, 0.74, -15.0)
    m.put(
        pieces.armchair(
            f.leather((0.42, 0.22, 0.14), 12), f.plaid(f.NAVY, f.CREAM, f.TERRACOTTA, 11)
        ),
        7.6,
        4.4,
        0,
        135.0,
    )
    m.put(objects.rug(1.9, 1.4, PERSIAN, 30), 7.5, 5.2)
    m.put(objects.floor_lamp(0), 9.25, 4.1)
    m.put(pieces.globe(6), 8.95, 0.4)
    m.put(objects.leafy_plant(1.6, 4, 46), 0.5, 7.1)
    m.put(objects.leafy_plant(1.3, 2, 40), 9.1, 0.5)
    m.put(objects.picture("landscape", 170, 1.2, 0.8, 1.9), 0.0, 5.8, 0, "e")
    m.put(objects.picture("sunset", 171, 1.3, 0.9, 1.9), 7.7, 0.0, 0, "n")
    m.put(objects.picture("poster", 172, 0.6, 0.85, 1.8), 3.5, 7.6, 0, "s")
    for x, y in ((2.4, 2.4), (6.8, 2.4), (2.2, 5.7), (5.2, 5.7), (7.6, 5.2)):
        m.put(objects.pendant(3.0, 0.55, 0.26, 3, 2.2), x, y)


def _study(m: Model) -> None:
    m.put(pieces.desk(1.5, f.wood(f.WALNUT, 15), 33, 1), 11.4, 0.0, 0, "n")
    m.put(pieces.office_chair(f.leather((0.3, 0.17, 0.12), 13)), 11.4, 1.0, 0, 170.0)
    m.put(pieces.bookshelf(1.2, 2.1, f.wood(f.WALNUT, 15), 232), 9.72, 2.6, 0, "e")
    m.put(objects.rug(1.6, 1.2, NORDIC, 31), 11.2, 2.3)
    m.put(
        objects.curtains(1.4, 2.4, f.striped((f.SAGE, f.CREAM, f.MUSTARD), 16)), 12.8, 1.7, 0, "w"
    )
    m.put(objects.picture_group(175, 1.75), 10.6, 3.6, 0, "s")
    m.put(objects.pendant(2.7, 0.45, 0.22, 1, 2.0), 11.2, 1.8)
    m.put(objects.leafy_plant(1.1, 6, 34), 10.15, 0.45)


def _foyer(m: Model) -> None:
    m.put(
        objects.wall_mirror(1.2, 1.7, 1.5, f.enamel((0.72, 0.58, 0.3), 4, 0.6)), 12.8, 6.3, 0, "w"
    )
    m.put(objects.coat_rack(1), 9.72, 7.0 - 0.0, 0, "e")
    m.put(pieces.bench(1.3, f.wood(f.OAK, 15), f.leather(f.TEAL, 14)), 12.45, 5.0, 0, "w")
    m.put(pieces.drawers(1.0, 0.95, 0.42, f.wood(f.OAK, 15), 2, 4), 9.72, 4.35, 0, "e")
    m.put(objects.vase(2, 0.36), 9.95, 4.1, 0.95)
    m.put(pieces.globe(8), 9.95, 4.55, 0.95)
    m.put(objects.picture("poster", 180, 0.7, 0.95, 1.7), 10.6, 3.72, 0, "n")
    m.put(pieces.plinth_sculpture(5, f.marble((0.9, 0.89, 0.86), (0.5, 0.5, 0.5), 79)), 12.2, 7.1)
    m.put(objects.radiator(1.2), 11.2, 7.6, 0, "s")
    m.put(objects.pendant(2.7, 0.45, 0.26, 4, 2.2), 11.2, 5.6)


def build() -> World:
    """Makes the library."""
    m = plan().build()
    for furnish in (_hall, _study, _foyer):
        furnish(m)
    return assemble("library", m, (7.6, 3.0, 1.3), 190.0, SUMMARY)
