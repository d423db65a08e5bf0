"""The classroom: rows of desks before a blackboard, a cloakroom and a science store."""

from r3jax.simulators.scenes.procedural.floorplan import FloorPlan
from r3jax.simulators.scenes.procedural.furniture import kitchen, objects, pieces
from r3jax.simulators.scenes.procedural.furniture.pieces import bench
from r3jax.simulators.scenes.procedural.materials import finishes as f
from r3jax.simulators.scenes.procedural.model import Model, assemble
from r3jax.simulators.world import World

SUMMARY = "classroom with a blackboard, a cloakroom and a store, 80 m2"


def plan() -> FloorPlan:
    """Lays out rooms, doorways and windows."""
    drawn, ceiling = FloorPlan(), f.acoustic_ceiling(5)
    gray = f.enamel((0.5, 0.52, 0.5), 3, 0.2)
    speckled = f.terrazzo(
        (0.6, 0.64, 0.62), ((0.4, 0.45, 0.45), (0.75, 0.78, 0.74), (0.3, 0.36, 0.4)), 101
    )
    drawn.room(
        "classroom",
        (0, 0, 8.6, 6.8),
        wall=f.plaster((0.9, 0.85, 0.68), 102),
        floor=f.plank_floor(f.PINE, 103, 0.3, 20),
        ceiling=ceiling,
        height=2.9,
        skirting=gray,
        sides={"s": f.plaster((0.7, 0.78, 0.76), 104)},
    )
    shields = f.tiled(((0.86, 0.82, 0.66), (0.6, 0.68, 0.6), (0.8, 0.6, 0.42)), 105, 8, 8, 0.15)
    drawn.room(
        "cloakroom",
        (8.72, 0, 11.4, 4.0),
        wall=f.plaster((0.88, 0.84, 0.76), 106),
        floor=speckled,
        ceiling=ceiling,
        wainscot=(1.3, shields),
        height=2.7,
    )
    drawn.room(
        "store",
        (8.72, 4.12, 11.4, 6.8),
        wall=f.plaster((0.76, 0.8, 0.84), 107),
        floor=speckled,
        ceiling=ceiling,
        skirting=gray,
        height=2.7,
    )
    drawn.doorway("x", (8.6, 8.72), 1.2)
    drawn.doorway("y", (4.0, 4.12), 9.6)
    for center, view in ((1.6, 61), (4.3, 62), (7.0, 63)):
        drawn.window("classroom", "n", center, 2.0, 0.95, 2.5, view)
    drawn.window("cloakroom", "s", 10.0, 1.2, 1.2, 2.2, 64)
    return drawn


def _classroom(m: Model) -> None:
    # Pupils look west, towards the blackboard.
    for row in range(3):
        for column in range(3):
            m.put(
                pieces.school_desk(row * 3 + column),
                3.1 + 1.75 * row,
                1.4 + 2.0 * column,
                0,
                270.0,
            )
    m.put(objects.board("black", 3.2, 1.2, 1.55, 2), 0.0, 3.4, 0, "e")
    m.put(pieces.lectern(f.wood(f.OAK, 13)), 1.25, 1.3, 0, "e")
    m.put(objects.clock(5, 2.5), 0.0, 3.4, 0, "e")
    m.put(objects.picture("landscape", 150, 1.1, 0.8, 1.7), 0.0, 5.9, 0, "e")
    m.put(pieces.bookshelf(1.8, 1.3, f.wood(f.PINE, 6), 95), 8.6, 3.3, 0, "w")
    m.put(pieces.bookshelf(1.8, 1.3, f.wood(f.PINE, 6), 97), 8.6, 5.4, 0, "w")
    m.put(pieces.globe(5), 8.4, 2.8, 1.3)
    m.put(objects.leafy_plant(0.6, 5, 26), 8.4, 5.2, 1.3)
    m.put(objects.vase(9), 8.4, 3.8, 1.3)
    kinds = ("poster", "landscape", "abstract", "poster", "sunset", "abstract", "poster", "poster")
    for k, kind in enumerate(kinds):
        m.put(
            objects.picture(kind, 151 + k, 0.62, 0.82, 1.65 + 0.12 * (k % 2)),
            1.0 + 0.95 * k,
            0.0,
            0,
            "n",
        )
    for x in (1.6, 4.3, 7.0):
        m.put(objects.radiator(1.6), x, 6.8, 0, "s")
    m.put(objects.picture_group(160, 1.95), 8.6, 4.3, 0, "w")
    m.put(objects.leafy_plant(1.3, 7, 40), 0.5, 6.3)
    for x in (2.2, 6.2):
        for y in (1.9, 4.9):
            m.put(objects.ceiling_panel(2.9, 1.5, 0.3, 2.3), x, y)


def _side_rooms(m: Model) -> None:
    m.put(objects.coat_rack(0), 11.4, 1.0, 0, "w")
    m.put(objects.coat_rack(1), 11.4, 2.1, 0, "w")
    m.put(objects.coat_rack(2), 11.4, 3.2, 0, "w")
    m.put(bench(2.6, f.wood(f.PINE, 7), f.leather(f.TERRACOTTA, 10)), 11.15, 2.1, 0, "w")
    m.put(kitchen.washbasin(1.0, f.enamel(f.MUSTARD, 6, 0.3), 8), 8.72, 3.0, 0, "e")
    m.put(objects.picture("poster", 165, 0.5, 0.7), 10.8, 4.0, 0, "s")
    m.put(objects.ceiling_panel(2.7, 1.2, 0.3, 2.2), 10.0, 2.0)
    m.put(pieces.bookshelf(2.2, 2.1, f.wood(f.BEECH, 7), 99), 11.4, 5.5, 0, "w")
    m.put(pieces.drawers(1.2, 1.0, 0.45, f.wood(f.PINE, 8), 2, 4), 9.4, 6.8, 0, "s")
    m.put(pieces.globe(4), 9.2, 6.55, 1.0)
    m.put(objects.carton(7, 0.3, 0.22, 0.24), 9.7, 6.55, 1.0)
    m.put(objects.wall_shelf(1.2, 1.7, kitchen.kitchen_shelf(3)), 9.5, 6.8, 0, "s")
    m.put(objects.board("white", 1.1, 0.8, 1.55, 12), 8.72, 5.5, 0, "e")
    m.put(objects.ceiling_panel(2.7, 0.6, 0.6, 2.2), 10.0, 5.4)


def build() -> World:
    """Makes the classroom."""
    m = plan().build()
    _classroom(m)
    _side_rooms(m)
    return assemble("classroom", m, (1.9, 3.4, 1.3), 0.0, SUMMARY)
