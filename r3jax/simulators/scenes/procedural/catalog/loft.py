"""The loft: one large brick room with columns and beams, a bathroom and a dressing room."""

import numpy as np

from r3jax.simulators.scenes.procedural.floorplan import FloorPlan
from r3jax.simulators.scenes.procedural.furniture import kitchen, objects, pieces
from r3jax.simulators.scenes.procedural.materials import finishes as f
from r3jax.simulators.scenes.procedural.materials.finishes import BERBER, PERSIAN
from r3jax.simulators.scenes.procedural.model import Model, assemble
from r3jax.simulators.scenes.procedural.shapes import box, cylinder, tube
from r3jax.simulators.world import World

SUMMARY = "brick loft with columns and beams, bathroom and dressing room, 72 m2"


def plan() -> FloorPlan:
    """Lays out rooms, doorways and windows."""
    drawn, brick = FloorPlan(), f.brick(7)
    floor = f.concrete((0.62, 0.6, 0.57), 31)
    drawn.room(
        "loft",
        (0, 0, 9.0, 6.4),
        wall=brick,
        floor=f.plank_floor((0.6, 0.43, 0.28), 32, 0.35, 10),
        ceiling=f.plank_floor((0.78, 0.66, 0.5), 33, 0.0, 16),
        height=3.0,
        sides={"n": f.plaster((0.86, 0.84, 0.8), 34), "e": f.concrete((0.66, 0.65, 0.62), 35)},
    )
    drawn.room(
        "bath",
        (9.12, 3.5, 11.5, 6.4),
        wall=f.concrete((0.7, 0.69, 0.66), 36),
        floor=f.tiled(((0.3, 0.33, 0.35), (0.36, 0.4, 0.42), (0.25, 0.27, 0.3)), 37, 6, 6, 0.3),
        ceiling=f.plaster((0.9, 0.9, 0.88), 38),
        wainscot=(
            2.1,
            f.tiled(
                ((0.2, 0.36, 0.36), (0.25, 0.43, 0.42), (0.3, 0.48, 0.46)), 39, 8, 16, 0.1, 0.5
            ),
        ),
        height=2.6,
    )
    drawn.room(
        "dressing",
        (9.12, 0, 11.5, 3.38),
        wall=f.wallpaper(
            (0.3, 0.34, 0.33),
            ((0.38, 0.46, 0.42), (0.55, 0.5, 0.36), (0.7, 0.5, 0.42)),
            "botanical",
            18,
        ),
        floor=f.carpet((0.55, 0.5, 0.44), (0.72, 0.66, 0.58), 8),
        ceiling=f.plaster((0.9, 0.9, 0.88), 38),
        height=2.6,
    )
    steel = f.metal((0.3, 0.31, 0.32), 3, 0.05)
    drawn.doorway("x", (9.0, 9.12), 4.4, frame=steel, floor=floor)
    drawn.doorway("x", (9.0, 9.12), 1.2, frame=steel, floor=floor)
    for center, view in ((1.6, 21), (4.4, 22), (7.2, 23)):
        drawn.window("loft", "s", center, 2.0, 0.7, 2.6, view)
    drawn.window("loft", "w", 4.6, 1.8, 0.7, 2.6, 24)
    return drawn


def _structure(m: Model) -> None:
    steel, timber = f.enamel((0.24, 0.27, 0.28), 3, 0.3), f.wood((0.5, 0.36, 0.24), 5, 0.05)
    for x in np.arange(0.75, 9.0, 1.5):
        m.add(box((x - 0.09, 0.0, 2.78), (x + 0.09, 6.4, 3.0), step=0.6), timber)
    for x in (3.0, 6.0):
        m.add(cylinder(0.1, 0.0, 2.78, 16).moved(x, 3.2), steel)
        m.add(box((x - 0.16, 3.04, 2.72), (x + 0.16, 3.36, 2.78)), steel)
    duct = tube([(0.0, 5.9, 2.6), (4.5, 5.9, 2.6), (9.0, 5.9, 2.6)], 0.15, 14)
    m.add(duct, f.metal((0.72, 0.73, 0.74), 6, 0.2))


def _live(m: Model) -> None:
    hide = f.leather((0.45, 0.27, 0.16), 7)
    pillows = (f.plaid(f.CREAM, f.NAVY, f.TERRACOTTA, 8), f.fabric(f.MUSTARD, 4))
    m.put(pieces.sofa(2.3, hide, pillows, 6), 5.0, 1.55, 0, "w")
    m.put(objects.rug(2.6, 1.9, PERSIAN, 12), 3.1, 1.5)
    m.put(pieces.coffee_table(f.wood(f.EBONY, 4), 8, 1.1), 3.3, 1.55, 0, "e")
    m.put(
        pieces.armchair(f.fabric(f.TEAL, 5), f.striped((f.MUSTARD, f.CREAM), 9)),
        1.9,
        0.45,
        0,
        15.0,
    )
    m.put(pieces.television_unit(1.7, f.wood(f.WALNUT, 7), 2), 0.0, 1.9, 0, "e")
    m.put(objects.floor_lamp(1), 5.3, 0.35)
    m.put(objects.leafy_plant(1.6, 5, 46), 0.5, 0.5)
    m.put(pieces.library_shelf(1.5, 1.15, f.wood(f.OAK, 6), 40), 3.0, 4.75, 0, 90.0)
    m.put(
        pieces.bed(
            1.6,
            f.printed((0.5, 0.53, 0.55), ((0.6, 0.62, 0.64), f.CREAM), "damask", 10),
            f.plaid(f.TERRACOTTA, f.CREAM, f.CHARCOAL, 9),
            f.wood(f.WALNUT, 8),
        ),
        1.35,
        6.4,
        0,
        "s",
    )
    m.put(pieces.nightstand(f.wood(f.WALNUT, 8), 8), 2.45, 6.4, 0, "s")
    m.put(objects.picture("abstract", 12, 1.2, 0.9, 1.75), 1.35, 6.4, 0, "s")
    for x, seed in ((1.5, 0), (4.4, 2), (7.4, 5)):
        m.put(objects.pendant(2.78, 0.5, 0.28, seed, 2.4), x, 3.0)


def _cook_and_work(m: Model) -> None:
    top = f.concrete((0.55, 0.55, 0.54), 41)
    splash = f.tiled(((0.88, 0.88, 0.86), (0.8, 0.82, 0.82)), 42, 10, 20, 0.075, 0.5)
    m.put(
        kitchen.kitchen_run(
            3.0, f.enamel((0.2, 0.22, 0.23), 4, 0.3), top, splash, 12, uppers=False
        ),
        5.7,
        6.4,
        0,
        "s",
    )
    m.put(kitchen.fridge(6), 7.6, 6.4, 0, "s")
    m.put(kitchen.island(1.6, f.wood(f.WALNUT, 9), top, 7), 5.4, 4.4)
    for x in (4.9, 5.7):
        m.put(pieces.stool(f.metal((0.32, 0.33, 0.34), 3, 0.05)), x, 3.75)
    m.put(
        pieces.dining_set(1.6, 0.9, f.wood(f.EBONY, 6), f.leather((0.5, 0.33, 0.22), 5), 8),
        7.2,
        1.6,
    )
    m.put(objects.pendant(2.78, 0.6, 0.3, 3, 2.2), 7.2, 1.6)
    m.put(objects.board("black", 1.4, 0.9, 1.6, 6), 9.0, 2.8, 0, "w")
    m.put(objects.picture("poster", 9, 0.7, 1.0, 1.7), 9.0, 5.7, 0, "w")
    m.put(pieces.drawers(1.0, 0.9, 0.42, f.enamel(f.MUSTARD, 5, 0.3), 2, 3), 8.5, 6.4, 0, "s")
    m.put(objects.vase(6, 0.35), 8.3, 6.2, 0.9)
    m.put(objects.clutter(12), 8.7, 6.2, 0.9)
    m.put(pieces.globe(3), 8.5, 6.2, 0.9)


def _side_rooms(m: Model) -> None:
    m.put(kitchen.bathtub(1.7), 10.3, 6.4, 0, "s")
    m.put(kitchen.toilet(), 11.5, 4.0, 0, "w")
    m.put(kitchen.washbasin(0.8, f.wood(f.OAK, 7), 6), 11.5, 5.0, 0, "w")
    m.put(kitchen.towel_rail(6), 9.12, 5.4, 0, "e")
    m.put(objects.ceiling_panel(2.6, 0.5, 0.5, 2.0), 10.2, 4.6)
    m.put(pieces.wardrobe(2.0, 2.2, f.wood(f.OAK, 9)), 11.5, 1.7, 0, "w")
    m.put(pieces.wardrobe(1.4, 2.2, f.enamel(f.SAGE, 5, 0.2), False), 10.0, 3.38, 0, "s")
    m.put(objects.coat_rack(2), 10.2, 0.0, 0, "n")
    m.put(objects.rug(1.3, 1.0, BERBER, 14), 10.1, 1.5)
    m.put(pieces.bench(0.9, f.wood(f.OAK, 9), f.fabric(f.BLUSH, 3)), 9.8, 0.4)
    m.put(objects.pendant(2.6, 0.35, 0.2, 4, 1.9), 10.1, 1.6)


def build() -> World:
    """Makes the loft."""
    m = plan().build()
    for furnish in (_structure, _live, _cook_and_work, _side_rooms):
        furnish(m)
    return assemble("loft", m, (4.0, 3.1, 1.3), 235.0, SUMMARY, ambient=0.74)
