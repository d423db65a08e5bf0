"""The gallery: three halls with pictures, sculptures, benches and a large mirror."""

from r3jax.simulators.scenes.procedural.floorplan import FloorPlan
from r3jax.simulators.scenes.procedural.furniture import objects, pieces
from r3jax.simulators.scenes.procedural.materials import finishes as f
from r3jax.simulators.scenes.procedural.materials.finishes import CHIPS, PERSIAN
from r3jax.simulators.scenes.procedural.model import Model, assemble
from r3jax.simulators.world import World

SUMMARY = "gallery of three halls with pictures, sculptures and a wall mirror, 88 m2"


def plan() -> FloorPlan:
    """Lays out rooms, doorways and windows."""
    drawn = FloorPlan()
    gilt, damask = f.enamel((0.62, 0.5, 0.28), 3, 0.5), ((0.5, 0.19, 0.18), (0.56, 0.25, 0.2))
    drawn.room(
        "red",
        (0, 0, 6.4, 6.0),
        wall=f.wallpaper((0.44, 0.13, 0.13), damask, "damask", 20),
        floor=f.parquet_floor((0.66, 0.46, 0.28), 71, 0.5),
        ceiling=f.plaster((0.92, 0.9, 0.86), 72),
        height=3.0,
        skirting=f.enamel((0.3, 0.2, 0.14), 3),
        wainscot=(0.85, f.wood(f.WALNUT, 10)),
    )
    drawn.room(
        "white",
        (6.6, 0, 12.6, 4.4),
        wall=f.plaster((0.9, 0.89, 0.87), 73),
        floor=f.terrazzo((0.72, 0.71, 0.68), CHIPS, 74),
        ceiling=f.concrete((0.72, 0.71, 0.69), 75),
        height=3.0,
    )
    drawn.room(
        "blue",
        (6.6, 4.6, 12.6, 8.6),
        wall=f.plaster((0.24, 0.32, 0.44), 76),
        floor=f.marble((0.82, 0.8, 0.76), (0.42, 0.38, 0.34), 77, 0.12),
        ceiling=f.plaster((0.9, 0.9, 0.9), 78),
        height=2.8,
        skirting=gilt,
    )
    drawn.doorway("x", (6.4, 6.6), 1.6, 1.6, 2.4, gilt)
    drawn.doorway("y", (4.4, 4.6), 10.6, 1.5, 2.4, gilt)
    drawn.doorway("x", (6.4, 6.6), 5.3, 1.2, 2.3, gilt)
    drawn.window("white", "s", 9.6, 2.6, 0.8, 2.6, 41)
    drawn.window("blue", "n", 8.6, 1.4, 1.0, 2.4, 42)
    return drawn


def _red_hall(m: Model) -> None:
    gilt = f.enamel((0.72, 0.58, 0.3), 4, 0.6)
    m.put(objects.picture("landscape", 90, 1.7, 1.2, 1.75, gilt), 2.0, 6.0, 0, "s")
    m.put(objects.picture("sunset", 91, 1.2, 0.9, 1.75, gilt), 4.6, 6.0, 0, "s")
    for k, y in enumerate((1.2, 2.9, 4.6)):
        m.put(
            objects.picture(
                ("sunset", "landscape", "sunset")[k],
                92 + k,
                0.9 + 0.3 * (k == 1),
                1.1 - 0.3 * (k == 1),
                1.75,
                gilt,
            ),
            0.0,
            y,
            0,
            "e",
        )
    m.put(objects.wall_mirror(1.8, 1.6, 1.75, gilt), 2.2, 0.0, 0, "n")
    m.put(objects.picture("landscape", 96, 0.8, 0.6, 1.8, gilt), 4.6, 0.0, 0, "n")
    m.put(objects.picture("abstract", 31, 0.7, 0.95, 1.8, gilt), 6.4, 3.6, 0, "w")
    m.put(pieces.bench(1.6, f.wood(f.WALNUT, 11), f.leather((0.3, 0.1, 0.1), 6)), 3.2, 4.2)
    m.put(objects.rug(3.0, 2.0, PERSIAN, 18), 3.2, 3.0)
    m.put(pieces.plinth_sculpture(2, f.marble((0.9, 0.89, 0.86), (0.5, 0.5, 0.5), 79)), 1.1, 5.1)
    m.put(pieces.plinth_sculpture(1, gilt), 5.5, 0.8)
    m.put(pieces.sideboard(1.5, f.wood(f.WALNUT, 11), 9), 4.4, 0.0, 0, "n")
    m.put(objects.leafy_plant(1.4, 2, 40), 0.5, 0.5)
    m.put(pieces.spotlight_rail(4.4, 3.0, 3), 3.2, 4.7)
    m.put(pieces.spotlight_rail(4.4, 3.0, 3), 3.2, 1.3, 0, 180.0)


def _white_hall(m: Model) -> None:
    white = f.enamel(f.WHITE, 3, 0.2)
    for k, x in enumerate((7.5, 8.9)):
        m.put(objects.picture("abstract", 40 + k, 0.9, 1.2, 1.6, white), x, 4.4, 0, "s")
    m.put(objects.picture("abstract", 46, 1.9, 1.4, 1.6, white), 12.6, 2.2, 0, "w")
    m.put(objects.picture("poster", 47, 0.8, 1.1, 1.6, white), 6.6, 3.4, 0, "e")
    for k, (x, y) in enumerate(((7.8, 0.9), (11.5, 0.9), (9.4, 2.9))):
        stone = (
            f.terrazzo((0.3, 0.32, 0.34), CHIPS, 80)
            if k % 2
            else f.marble((0.85, 0.72, 0.6), (0.5, 0.35, 0.25), 81)
        )
        m.put(pieces.plinth_sculpture(k + 2, stone), x, y)
    m.put(pieces.bench(1.4, f.wood(f.OAK, 10), f.fabric(f.CHARCOAL, 4)), 9.6, 0.6)
    m.put(pieces.spotlight_rail(4.0, 3.0, 3), 9.4, 3.2)
    m.put(pieces.spotlight_rail(4.0, 3.0, 2), 9.6, 1.2, 0, 180.0)


def _blue_hall(m: Model) -> None:
    gilt, oak = f.enamel((0.72, 0.58, 0.3), 4, 0.6), f.wood(f.OAK, 11)
    for k, x in enumerate((7.5, 8.4, 9.3)):
        m.put(
            objects.picture(("poster", "landscape", "abstract")[k], 100 + k, 0.6, 0.8, 1.6, gilt),
            x,
            4.6,
            0,
            "n",
        )
    m.put(objects.wall_mirror(1.4, 1.9, 1.45, gilt), 12.6, 6.6, 0, "w")
    m.put(objects.picture("sunset", 105, 1.2, 0.9, 1.65, gilt), 10.6, 8.6, 0, "s")
    m.put(objects.picture("landscape", 106, 1.0, 0.75, 1.65, gilt), 6.6, 7.3, 0, "e")
    m.put(pieces.bookshelf(1.4, 1.2, oak, 61), 11.8, 8.6, 0, "s")
    m.put(pieces.table(1.3, 0.7, oak, 0.8), 8.3, 6.6)
    m.put(objects.vase(4, 0.4), 8.0, 6.6, 0.8)
    m.put(pieces.globe(2), 8.55, 6.65, 0.8)
    m.put(objects.book_pile(5, 12), 8.3, 6.45, 0.8)
    m.put(pieces.plinth_sculpture(3, gilt), 7.2, 8.0)
    m.put(objects.leafy_plant(1.3, 6, 38), 12.1, 5.1)
    m.put(
        objects.curtains(1.4, 2.55, f.striped((f.NAVY, (0.6, 0.5, 0.3), f.NAVY), 12)),
        8.6,
        8.6,
        0,
        "s",
    )
    m.put(objects.pendant(2.8, 0.45, 0.3, 1, 2.4), 8.3, 6.6)
    m.put(objects.pendant(2.8, 0.45, 0.3, 1, 2.4), 11.0, 6.6)


def build() -> World:
    """Makes the gallery."""
    m = plan().build()
    for furnish in (_red_hall, _white_hall, _blue_hall):
        furnish(m)
    return assemble("gallery", m, (3.2, 2.6, 1.3), 115.0, SUMMARY)
