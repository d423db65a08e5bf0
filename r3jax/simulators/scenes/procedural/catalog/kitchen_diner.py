"""The kitchen-diner: a family kitchen with an island, a dining corner and a pantry."""

from r3jax.simulators.scenes.procedural.floorplan import FloorPlan
from r3jax.simulators.scenes.procedural.furniture import kitchen, objects, pieces
from r3jax.simulators.scenes.procedural.materials import finishes as f
from r3jax.simulators.scenes.procedural.materials.finishes import CHIPS, NORDIC
from r3jax.simulators.scenes.procedural.model import Model, assemble
from r3jax.simulators.world import World

SUMMARY = "kitchen-diner with an island, marble worktops and a pantry, 32 m2"


def plan() -> FloorPlan:
    """Lays out rooms, doorways and windows."""
    drawn, ceiling = FloorPlan(), f.plaster((0.93, 0.92, 0.9), 50, 0.7)
    lines = ((0.8, 0.78, 0.72), (0.5, 0.6, 0.5))
    drawn.room(
        "kitchen",
        (0, 0, 6.0, 4.3),
        wall=f.plaster((0.82, 0.86, 0.84), 15),
        floor=f.terrazzo((0.8, 0.78, 0.74), CHIPS, 9),
        ceiling=ceiling,
        skirting=f.enamel(f.WHITE, 3, 0.2),
        sides={
            "w": f.wallpaper((0.9, 0.87, 0.8), lines, "lines", 5),
            "e": f.brick(6, (0.72, 0.62, 0.55)),
        },
    )
    drawn.room(
        "pantry",
        (6.12, 0.8, 8.0, 4.3),
        wall=f.plaster((0.86, 0.8, 0.7), 16),
        floor=f.tiled((f.WHITE, f.CHARCOAL), 26, 6, 6, 0.2),
        ceiling=ceiling,
        height=2.5,
    )
    drawn.doorway("x", (6.0, 6.12), 1.55)
    drawn.window("kitchen", "s", 1.6, 1.7, 0.9, 2.2, 12)
    drawn.window("kitchen", "w", 2.2, 1.2, 0.9, 2.2, 13)
    return drawn


def _cooking(m: Model) -> None:
    blue, stone = (
        f.enamel((0.22, 0.32, 0.44), 3, 0.4),
        f.marble((0.9, 0.89, 0.87), (0.45, 0.43, 0.42), 8),
    )
    splash = f.tiled((f.WHITE, (0.86, 0.88, 0.9), (0.7, 0.78, 0.84)), 27, 10, 20, 0.075, 0.5)
    m.put(kitchen.kitchen_run(4.2, blue, stone, splash, 9), 3.1, 4.3, 0, "s")
    m.put(kitchen.fridge(1), 0.5, 4.3, 0, "s")
    m.put(kitchen.island(1.5, f.wood(f.OAK, 2), stone, 2), 3.9, 2.2)
    for x in (3.5, 4.2):
        m.put(pieces.stool(f.wood(f.OAK, 2)), x, 1.55)
    for x in (3.5, 4.3):
        m.put(objects.pendant(2.6, 0.55, 0.15, 2, 1.7), x, 2.2)
    m.put(objects.wall_shelf(1.3, 1.5, kitchen.kitchen_shelf(1)), 6.0, 3.2, 0, "w")
    m.put(objects.wall_shelf(1.3, 1.95, kitchen.kitchen_shelf(7)), 6.0, 3.2, 0, "w")


def _dining(m: Model) -> None:
    m.put(objects.rug(1.9, 1.6, NORDIC, 2), 1.3, 1.3)
    m.put(
        pieces.dining_set(
            1.2, 0.8, f.wood(f.PINE, 2), f.plaid(f.TERRACOTTA, f.CREAM, f.NAVY, 3), 5
        ),
        1.3,
        1.3,
    )
    m.put(objects.pendant(2.6, 0.55, 0.25, 0), 1.3, 1.3)
    m.put(
        objects.curtains(
            1.7, 2.35, f.printed(f.CREAM, (f.TERRACOTTA, f.MUSTARD, f.TEAL), "botanical", 17)
        ),
        1.6,
        0,
        0,
        "n",
    )
    m.put(pieces.drawers(1.0, 0.85, 0.4, f.wood(f.PINE, 4), 2, 3), 3.7, 0.0, 0, "n")
    m.put(objects.table_lamp(2), 3.4, 0.2, 0.85)
    m.put(objects.book_pile(5, 3), 3.75, 0.2, 0.85)
    m.put(objects.vase(7), 4.0, 0.2, 0.85)
    m.put(objects.picture_group(50, 1.75), 3.8, 0.0, 0, "n")
    m.put(objects.leafy_plant(1.4, 4, 42), 5.45, 0.45)
    m.put(objects.radiator(0.9), 0.0, 2.2, 0, "e")
    m.put(objects.clock(2), 0.0, 3.2, 0, "e")


def _pantry(m: Model) -> None:
    shelves, rows = f.wood(f.PINE, 5), (0.35, 0.75, 1.15, 1.55, 1.95)
    for k, z in enumerate(rows):
        m.put(objects.wall_shelf(2.4, z, kitchen.kitchen_shelf(11 * k, 2.4)), 8.0, 2.9, 0, "w")
        m.put(objects.wall_shelf(1.6, z, kitchen.kitchen_shelf(5 + 7 * k, 1.6)), 7.05, 4.3, 0, "s")
    m.put(pieces.drawers(0.5, 0.9, 0.4, shelves, 1, 3), 6.12, 3.5, 0, "e")
    m.put(objects.bowl_of_fruit(3), 6.32, 3.5, 0.9)
    m.put(objects.picture("poster", 4, 0.4, 0.55), 6.12, 2.7, 0, "e")
    m.put(objects.ceiling_panel(2.5, 0.6, 0.3, 1.8), 7.0, 2.3)


def build() -> World:
    """Makes the kitchen-diner."""
    m = plan().build()
    for furnish in (_cooking, _dining, _pantry):
        furnish(m)
    return assemble("kitchen", m, (2.3, 2.8, 1.3), 300.0, SUMMARY)
