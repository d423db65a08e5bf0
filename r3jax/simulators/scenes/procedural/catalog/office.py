"""The office: desk islands, a meeting room behind glass, a break room and a copy room."""

from r3jax.simulators.scenes.procedural.floorplan import FloorPlan
from r3jax.simulators.scenes.procedural.furniture import kitchen, objects, pieces
from r3jax.simulators.scenes.procedural.materials import finishes as f
from r3jax.simulators.scenes.procedural.materials.finishes import NORDIC
from r3jax.simulators.scenes.procedural.model import Model, assemble
from r3jax.simulators.world import World

SUMMARY = "open-plan office with glass partitions, meeting room, break room and copy room, 88 m2"


def plan() -> FloorPlan:
    """Lays out rooms, doorways and windows."""
    drawn, ceiling = FloorPlan(), f.acoustic_ceiling(3)
    gray = f.carpet((0.4, 0.43, 0.47), (0.58, 0.6, 0.6), 5)
    skirting = f.enamel(f.CHARCOAL, 2, 0.2)
    drawn.room(
        "open",
        (0, 0, 10.4, 6.8),
        wall=f.plaster((0.87, 0.87, 0.85), 61),
        floor=gray,
        ceiling=ceiling,
        skirting=skirting,
        height=2.8,
        sides={"w": f.plaster((0.25, 0.42, 0.46), 62)},
    )
    drawn.room(
        "break",
        (10.52, 0, 13.2, 3.3),
        wall=f.wallpaper((0.88, 0.86, 0.8), ((0.75, 0.72, 0.62), (0.8, 0.55, 0.3)), "trellis", 19),
        floor=f.plank_floor(f.BEECH, 63, 0.25),
        ceiling=ceiling,
        height=2.6,
    )
    drawn.room(
        "copy",
        (10.52, 3.42, 13.2, 6.8),
        wall=f.plaster((0.84, 0.8, 0.72), 64),
        floor=gray,
        ceiling=ceiling,
        skirting=skirting,
        height=2.6,
    )
    drawn.doorway("x", (10.4, 10.52), 1.7, 1.3)
    drawn.doorway("x", (10.4, 10.52), 5.0, 1.3)
    for center, view in ((1.8, 31), (4.6, 32), (7.4, 33)):
        drawn.window("open", "s", center, 2.2, 0.9, 2.3, view)
    drawn.window("open", "w", 5.0, 1.8, 0.9, 2.3, 34)
    return drawn


def _meeting_room(m: Model) -> None:
    """Builds glass walls round x = 0 .. 4.2, y = 3.7 .. 6.8, open between x = 2.9 and 4.2."""
    m.put(pieces.glass_partition(2.9, 2.8), 1.45, 3.7)
    m.put(pieces.glass_partition(3.06, 2.8), 4.24, 5.27, 0, 90.0)
    m.put(pieces.meeting_table(1.8, 0.9, 3, 1), 1.7, 5.2)
    m.put(objects.board("white", 1.8, 1.1, 1.5, 4), 1.8, 6.8, 0, "s")
    m.put(objects.picture("poster", 10, 0.6, 0.85), 3.4, 6.8, 0, "s")
    m.put(objects.ceiling_panel(2.8), 1.7, 5.2)
    m.put(objects.leafy_plant(1.2, 3, 36), 0.4, 6.4)


def _desks(m: Model) -> None:
    m.put(pieces.desk_island(2, 4), 2.4, 1.75)
    m.put(pieces.desk_island(2, 9), 7.0, 1.75)
    m.put(pieces.workstation(15), 6.0, 6.8, 0, "s")
    m.put(pieces.workstation(18), 8.2, 6.8, 0, "s")
    m.put(pieces.bookshelf(1.2, 1.9, f.wood(f.BEECH, 4), 51), 10.4, 3.35, 0, "w")
    m.put(pieces.filing_cabinet(0), 9.6, 6.8, 0, "s")
    m.put(objects.clock(4, 2.2), 7.1, 6.8, 0, "s")
    m.put(objects.leafy_plant(1.5, 7, 44), 4.75, 1.75 - 1.2)
    m.put(objects.leafy_plant(1.3, 1, 40), 9.6, 0.5)
    m.put(objects.picture("abstract", 22, 1.1, 0.8), 0.0, 2.4, 0, "e")
    m.put(objects.board("white", 1.6, 1.0, 1.6, 11), 9.0 - 1.9, 6.8, 0, "s")
    m.put(objects.picture("landscape", 25, 0.8, 0.6, 1.7), 10.4, 0.5, 0, "w")
    for x in (2.4, 7.0):
        m.put(objects.ceiling_panel(2.8, 1.2, 0.6), x, 1.75)
    m.put(objects.ceiling_panel(2.8, 1.2, 0.6), 7.2, 5.0)


def _side_rooms(m: Model) -> None:
    front = f.enamel((0.86, 0.5, 0.28), 4, 0.3)
    splash = f.tiled((f.WHITE, f.CREAM), 65, 10, 10, 0.12)
    m.put(kitchen.kitchen_run(2.4, front, f.wood(f.BEECH, 6), splash, 14), 11.9, 0.0, 0, "n")
    m.put(pieces.table(0.8, 0.8, f.wood(f.BEECH, 3)), 12.55, 2.5)
    m.put(objects.bowl_of_fruit(4), 12.55, 2.5, 0.74)
    m.put(pieces.chair(f.wood(f.BEECH, 3), f.fabric(f.TEAL, 2)), 12.5, 2.0, 0, 10.0)
    m.put(pieces.chair(f.wood(f.BEECH, 3), f.fabric(f.MUSTARD, 2)), 12.0, 2.7, 0, -80.0)
    m.put(pieces.water_cooler(), 10.52, 2.9, 0, "e")
    m.put(objects.ceiling_panel(2.6, 0.6, 0.6, 2.1), 11.8, 1.7)
    m.put(objects.picture("poster", 13, 0.6, 0.8), 11.4, 3.3, 0, "s")
    m.put(objects.clock(1), 13.2, 1.4, 0, "w")
    m.put(pieces.copier(), 13.2, 4.2, 0, "w")
    m.put(pieces.filing_cabinet(1), 13.2, 5.4, 0, "w")
    m.put(pieces.filing_cabinet(2), 13.2, 6.3, 0, "w")
    m.put(pieces.bookshelf(1.8, 2.1, f.enamel((0.7, 0.71, 0.72), 5, 0.2), 55), 11.6, 6.8, 0, "s")
    m.put(objects.board("white", 1.2, 0.8, 1.6, 8), 11.7, 3.42, 0, "n")
    m.put(objects.rug(1.4, 1.0, NORDIC, 16), 11.6, 5.0)
    m.put(objects.ceiling_panel(2.6, 0.6, 0.6, 2.1), 11.8, 5.1)


def build() -> World:
    """Makes the office."""
    m = plan().build()
    for furnish in (_meeting_room, _desks, _side_rooms):
        furnish(m)
    return assemble("office", m, (5.3, 3.9, 1.3), 200.0, SUMMARY)
