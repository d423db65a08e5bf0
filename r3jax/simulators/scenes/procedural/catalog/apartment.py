"""The apartment: two bedrooms, a living room, a kitchen and a bathroom along a hall."""

from r3jax.simulators.scenes.procedural.floorplan import FloorPlan
from r3jax.simulators.scenes.procedural.furniture import kitchen, objects, pieces
from r3jax.simulators.scenes.procedural.materials import finishes as f
from r3jax.simulators.scenes.procedural.materials.finishes import BERBER, NORDIC, PERSIAN
from r3jax.simulators.scenes.procedural.model import Model, assemble
from r3jax.simulators.world import World

SUMMARY = "two-bedroom apartment with living room, kitchen, bathroom and hall, 90 m2"


def plan() -> FloorPlan:
    """Lays out rooms, doorways and windows."""
    drawn, white = FloorPlan(), f.enamel(f.WHITE, 3, 0.2)
    parquet, boards = f.parquet_floor(f.OAK, 14), f.plank_floor(f.WALNUT, 15, 0.25)
    ceiling = f.plaster((0.93, 0.92, 0.9), 50, 0.7)
    lilac = ((0.72, 0.68, 0.74), (0.56, 0.5, 0.62))
    surfaces = {
        "living": ((0, 0, 5.6, 4.2), f.plaster((0.8, 0.83, 0.8), 5), parquet),
        "kitchen": (
            (5.72, 0, 10.4, 4.2),
            f.plaster((0.88, 0.82, 0.68), 7),
            f.tiled((f.TERRACOTTA, (0.7, 0.4, 0.28), (0.8, 0.5, 0.36)), 16, 6, 6, 0.3),
        ),
        "hall": (
            (0, 4.32, 10.4, 5.82),
            f.wallpaper((0.86, 0.83, 0.76), ((0.78, 0.74, 0.66), (0.5, 0.58, 0.52)), "lines", 9),
            parquet,
        ),
        "bedroom": (
            (0, 5.94, 4.4, 9.3),
            f.wallpaper((0.36, 0.43, 0.52), ((0.44, 0.52, 0.6), (0.52, 0.58, 0.64)), "damask", 4),
            boards,
        ),
        "bath": (
            (4.52, 5.94, 6.9, 9.3),
            f.plaster((0.88, 0.87, 0.85), 3),
            f.terrazzo(
                (0.82, 0.8, 0.76), ((0.5, 0.3, 0.24), (0.3, 0.34, 0.36), (0.62, 0.6, 0.5)), 18
            ),
        ),
        "study": (
            (7.02, 5.94, 10.4, 9.3),
            f.wallpaper((0.88, 0.85, 0.86), lilac, "botanical", 12),
            f.carpet((0.5, 0.47, 0.5), (0.7, 0.66, 0.62), 4),
        ),
    }
    for name, (rect, wall, floor) in surfaces.items():
        drawn.room(name, rect, wall=wall, floor=floor, ceiling=ceiling, skirting=white, height=2.7)
    drawn.rooms["bath"].wainscot = (
        1.5,
        f.tiled((f.WHITE, (0.82, 0.86, 0.84), f.SAGE), 19, 10, 20, 0.1, 0.5),
    )
    drawn.rooms["living"].sides = {"w": f.plaster((0.45, 0.54, 0.5), 6)}
    drawn.doorway("x", (5.6, 5.72), 1.25, 1.4)
    for center in (4.6, 6.6):
        drawn.doorway("y", (4.2, 4.32), center)
    for center in (3.5, 5.7, 7.9):
        drawn.doorway("y", (5.82, 5.94), center)
    drawn.window("living", "s", 2.6, 2.2, 0.6, 2.3, 3)
    drawn.window("kitchen", "e", 2.4, 1.2, 0.95, 2.2, 9)
    drawn.window("bedroom", "n", 1.2, 1.4, 0.9, 2.2, 5)
    drawn.window("bath", "n", 5.7, 0.7, 1.5, 2.2, 6)
    drawn.window("study", "e", 7.6, 1.6, 0.9, 2.2, 8)
    return drawn


def _living(m: Model) -> None:
    walnut = f.wood(f.WALNUT, 2)
    pillows = (
        f.fabric(f.MUSTARD, 2),
        f.printed(f.CREAM, (f.NAVY, f.TEAL), "damask", 6),
        f.striped((f.BLUSH, f.CREAM), 5),
    )
    m.put(pieces.sofa(2.2, f.fabric((0.55, 0.52, 0.47), 2), pillows, 3), 0.1, 1.9, 0, "e")
    m.put(objects.rug(2.4, 1.7, BERBER, 8), 2.3, 1.9, 0, 90.0)
    m.put(pieces.coffee_table(walnut, 5, 1.0), 1.75, 1.9, 0, "e")
    m.put(pieces.television_unit(1.8, walnut, 1), 5.6, 2.9, 0, "w")
    m.put(
        pieces.armchair(f.leather((0.52, 0.32, 0.2), 3), f.fabric(f.CREAM, 1)), 2.6, 0.35, 0, 20.0
    )
    m.put(pieces.bookshelf(1.6, 2.2, f.wood(f.EBONY, 3), 21), 1.3, 4.2, 0, "s")
    m.put(pieces.bookshelf(0.8, 1.2, f.wood(f.EBONY, 3), 22), 2.7, 4.2, 0, "s")
    m.put(objects.leafy_plant(1.3, 2, 40), 0.5, 0.5)
    m.put(objects.floor_lamp(1), 0.45, 3.45)
    m.put(
        objects.curtains(
            2.2, 2.5, f.printed(f.CREAM, (f.SAGE, f.TEAL, f.MUSTARD), "botanical", 14)
        ),
        2.6,
        0,
        0,
        "n",
    )
    m.put(objects.picture("abstract", 5, 0.9, 1.1, 1.6), 0, 1.9, 0, "e")
    m.put(objects.picture("landscape", 17, 0.9, 0.65, 1.75), 2.8, 4.2, 0, "s")
    m.put(objects.pendant(2.7, 0.45, 0.26, 0), 2.8, 2.1)


def _kitchen(m: Model) -> None:
    splash = f.tiled((f.CREAM, f.NAVY, f.WHITE), 23, 10, 10, 0.12)
    stone = f.marble((0.3, 0.3, 0.31), (0.7, 0.68, 0.64), 24)
    front = f.enamel((0.86, 0.83, 0.76), 3, 0.35)
    m.put(kitchen.kitchen_run(3.6, front, stone, splash, 6, uppers=False), 8.4, 0.0, 0, "n")
    m.put(kitchen.fridge(3), 10.4, 1.1, 0, "w")
    m.put(objects.wall_shelf(0.9, 1.55, kitchen.kitchen_shelf(4, 0.9)), 10.4, 3.6, 0, "w")
    m.put(pieces.dining_set(1.5, 0.85, f.wood(f.OAK, 4), f.fabric(f.TEAL, 1), 2), 8.5, 2.55)
    m.put(objects.pendant(2.7, 0.6, 0.25, 1), 8.5, 2.55)
    m.put(objects.ceiling_panel(2.7, 0.9, 0.3, 2.0), 6.6, 1.6)
    m.put(objects.picture_group(30, 1.6), 8.9, 4.2, 0, "s")
    m.put(objects.clock(7), 5.72, 3.2, 0, "e")
    m.put(pieces.sideboard(1.2, f.wood(f.OAK, 4), 4), 9.6, 4.2, 0, "s")


def _hall(m: Model) -> None:
    m.put(objects.rug(3.0, 0.8, PERSIAN, 9), 3.0, 5.07)
    m.put(objects.rug(2.2, 0.8, NORDIC, 3), 7.6, 5.07)
    m.put(objects.coat_rack(0), 10.4, 5.07, 0, "w")
    m.put(objects.wall_mirror(0.7, 1.3, 1.4), 0.0, 5.07, 0, "e")
    m.put(pieces.drawers(0.9, 0.9, 0.3, f.wood(f.OAK, 5), 2, 3), 1.0, 5.82, 0, "s")
    m.put(objects.vase(3, 0.34), 0.8, 5.66, 0.9)
    m.put(objects.standing_frame(2), 1.2, 5.66, 0.9, "s")
    for k, x in enumerate((1.6, 2.7, 8.6, 9.5)):
        m.put(
            objects.picture(("poster", "abstract", "landscape", "poster")[k], 40 + k, 0.45, 0.6),
            x,
            4.32,
            0,
            "n",
        )
    m.put(objects.pendant(2.7, 0.3, 0.16, 2, 1.8), 2.4, 5.07)
    m.put(objects.pendant(2.7, 0.3, 0.16, 2, 1.8), 8.0, 5.07)


def _bedrooms(m: Model) -> None:
    oak, white = f.wood(f.OAK, 7), f.enamel(f.WHITE, 5, 0.25)
    m.put(
        pieces.bed(
            1.6,
            f.printed((0.86, 0.8, 0.76), (f.BLUSH, f.TERRACOTTA), "damask", 9),
            f.plaid(f.NAVY, f.CREAM, f.BLUSH, 6),
            oak,
        ),
        0.0,
        7.7,
        0,
        "e",
    )
    m.put(pieces.nightstand(oak, 4), 0.0, 6.6, 0, "e")
    m.put(pieces.nightstand(oak, 7), 0.0, 8.8, 0, "e")
    m.put(pieces.wardrobe(1.8, 2.2, f.wood(f.OAK, 8)), 4.4, 8.2, 0, "w")
    m.put(objects.curtains(1.4, 2.4, f.striped((f.NAVY, f.CREAM), 7)), 1.2, 9.3, 0, "s")
    m.put(objects.rug(2.2, 1.5, NORDIC, 6), 2.6, 7.5)
    m.put(objects.pendant(2.7, 0.4, 0.25, 4), 2.3, 7.5)
    m.put(objects.picture("sunset", 33, 0.9, 0.6, 1.7), 0.0, 7.7, 0, "e")
    m.put(objects.leafy_plant(0.9, 6, 30), 2.9, 9.0)
    m.put(objects.picture("landscape", 35, 0.7, 0.5), 1.8, 5.94, 0, "n")
    m.put(objects.radiator(1.0), 1.2, 9.3, 0, "s")
    m.put(pieces.desk(1.4, f.wood(f.BEECH, 3), 9, 2), 9.5, 5.94, 0, "n")
    m.put(pieces.office_chair(f.fabric(f.TEAL, 4)), 9.5, 6.95, 0, 165.0)
    m.put(
        pieces.bed(
            0.9,
            f.printed(f.CREAM, (f.TEAL, f.MUSTARD), "botanical", 8),
            f.fabric(f.MUSTARD, 3),
            white,
        ),
        7.55,
        9.3,
        0,
        "s",
    )
    m.put(pieces.bookshelf(1.4, 1.9, white, 33), 9.5, 9.3, 0, "s")
    m.put(
        objects.curtains(1.6, 2.4, f.printed(f.CREAM, (f.BLUSH, f.SAGE), "botanical", 15)),
        10.4,
        7.6,
        0,
        "w",
    )
    m.put(objects.picture_group(36, 1.65), 7.02, 7.6, 0, "e")
    m.put(objects.pendant(2.7, 0.4, 0.2, 6), 8.6, 7.6)
    m.put(objects.rug(1.5, 1.1, BERBER, 4), 8.9, 7.9)


def _bath(m: Model) -> None:
    m.put(kitchen.bathtub(), 6.9, 8.3, 0, "w")
    m.put(kitchen.toilet(), 4.52, 8.7, 0, "e")
    m.put(kitchen.washbasin(0.8, f.wood(f.WALNUT, 3), 5), 4.52, 7.6, 0, "e")
    m.put(kitchen.washing_machine(), 6.9, 6.8, 0, "w")
    m.put(kitchen.towel_rail(2), 4.9, 5.94, 0, "n")
    m.put(objects.ceiling_panel(2.7, 0.5, 0.5, 2.0), 5.7, 7.4)


def build() -> World:
    """Makes the apartment."""
    m = plan().build()
    for furnish in (_living, _kitchen, _hall, _bedrooms, _bath):
        furnish(m)
    return assemble("apartment", m, (3.7, 2.0, 1.3), 200.0, SUMMARY)
