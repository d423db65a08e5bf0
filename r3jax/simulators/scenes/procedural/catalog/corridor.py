"""The corridor: a long passage with three offices, an archive and a lounge along it."""

from r3jax.simulators.scenes.procedural.floorplan import FloorPlan
from r3jax.simulators.scenes.procedural.furniture import objects, pieces
from r3jax.simulators.scenes.procedural.materials import finishes as f
from r3jax.simulators.scenes.procedural.materials.finishes import BERBER, NORDIC, PERSIAN
from r3jax.simulators.scenes.procedural.model import Model, assemble
from r3jax.simulators.world import World

SUMMARY = "corridor with three offices, an archive and a lounge, 118 m2"


def plan() -> FloorPlan:
    """Lays out rooms, doorways and windows."""
    drawn, ceiling = FloorPlan(), f.acoustic_ceiling(4)
    white, gray = f.enamel(f.WHITE, 3, 0.2), f.carpet((0.45, 0.4, 0.37), (0.62, 0.56, 0.5), 10)
    green = f.enamel((0.42, 0.5, 0.42), 6, 0.25)
    drawn.room(
        "corridor",
        (0, 0, 14.0, 1.9),
        wall=f.plaster((0.86, 0.85, 0.78), 91),
        floor=f.tiled(((0.78, 0.74, 0.66), (0.5, 0.42, 0.36)), 92, 8, 8, 0.3, 0.0, 0.1),
        ceiling=ceiling,
        wainscot=(1.1, green),
        skirting=f.enamel((0.28, 0.33, 0.28), 3),
    )
    leaves = ((0.62, 0.7, 0.66), (0.45, 0.55, 0.5), (0.8, 0.6, 0.4))
    walls = (
        f.plaster((0.82, 0.76, 0.68), 93),
        f.wallpaper((0.84, 0.86, 0.84), leaves, "botanical", 21),
        f.plaster((0.68, 0.74, 0.8), 94),
    )
    for k, (x0, x1) in enumerate(((0, 4.6), (4.72, 9.3), (9.42, 14.0))):
        floor = f.plank_floor(f.BEECH, 95, 0.25) if k == 1 else gray
        drawn.room(
            f"office {k + 1}",
            (x0, 2.02, x1, 5.4),
            wall=walls[k],
            floor=floor,
            ceiling=ceiling,
            skirting=white,
        )
        drawn.doorway("y", (1.9, 2.02), x0 + 1.2, frame=green)
        drawn.window(f"office {k + 1}", "n", (x0 + x1) / 2, 2.2, 0.9, 2.2, 51 + k)
    drawn.room(
        "archive",
        (0, -3.4, 6.4, -0.12),
        wall=f.concrete((0.72, 0.71, 0.68), 96),
        floor=f.concrete((0.55, 0.54, 0.52), 97),
        ceiling=ceiling,
    )
    lines = ((0.72, 0.62, 0.5), (0.5, 0.3, 0.24))
    drawn.room(
        "lounge",
        (6.52, -3.4, 14.0, -0.12),
        wall=f.wallpaper((0.84, 0.76, 0.64), lines, "lines", 22),
        floor=f.parquet_floor(f.OAK, 98),
        ceiling=f.plaster((0.92, 0.91, 0.88), 99),
        skirting=white,
    )
    drawn.doorway("y", (-0.12, 0.0), 5.2, frame=green)
    drawn.doorway("y", (-0.12, 0.0), 11.6, 1.5, frame=green)
    drawn.window("lounge", "s", 9.0, 2.4, 0.6, 2.2, 54)
    drawn.window("corridor", "e", 0.95, 1.1, 0.9, 2.1, 55)
    return drawn


def _corridor(m: Model) -> None:
    for k, x in enumerate((2.3, 3.5, 7.2, 8.4, 12.0, 13.1)):
        m.put(
            objects.picture(("poster", "landscape", "abstract")[k % 3], 110 + k, 0.5, 0.65, 1.65),
            x,
            1.9,
            0,
            "s",
        )
    for k, x in enumerate((1.2, 2.6, 7.6, 9.2)):
        m.put(
            objects.picture(("sunset", "poster", "abstract", "poster")[k], 120 + k, 0.7, 0.5, 1.65),
            x,
            0.0,
            0,
            "n",
        )
    m.put(pieces.bench(1.3, f.wood(f.OAK, 12), f.leather(f.TEAL, 8)), 8.4, 0.28)
    m.put(objects.leafy_plant(1.1, 6, 34), 13.6, 0.4)
    m.put(objects.wall_mirror(0.8, 1.4, 1.45), 0.0, 0.95, 0, "e")
    m.put(objects.clock(8, 2.2), 4.3, 0.0, 0, "n")
    m.put(objects.radiator(1.0), 3.6, 0.0, 0, "n")
    for x in (2.3, 7.0, 11.7):
        m.put(objects.ceiling_panel(2.6, 1.2, 0.3, 2.2), x, 0.95)


def _offices(m: Model) -> None:
    for k, x0 in enumerate((0.0, 4.72, 9.42)):
        x1 = x0 + 4.58
        m.put(pieces.workstation(20 + k, 1.7), x0 + 1.0, 5.4, 0, "s") if k != 1 else m.put(
            pieces.desk_island(1, 24), x0 + 2.7, 4.3, 0, 90.0
        )
        m.put(
            pieces.bookshelf(1.5, 2.1, f.wood((f.OAK, f.WALNUT, f.BEECH)[k], 2), 70 + k),
            x1,
            3.2,
            0,
            "w",
        )
        m.put(pieces.filing_cabinet(k), x1, 4.9, 0, "w")
        m.put(objects.radiator(1.4), x0 + 3.0, 5.4, 0, "s")
        m.put(objects.board("white", 1.4, 0.9, 1.55, 30 + k), x0, 4.0, 0, "e")
        m.put(objects.leafy_plant(1.2, 3 + k, 34), x0 + 0.45, 2.5)
        m.put(objects.picture("landscape", 130 + k, 0.8, 0.55), x0 + 3.0, 2.02, 0, "n")
        m.put(objects.rug(1.8, 1.3, (NORDIC, BERBER, PERSIAN)[k], 20 + k), x0 + 2.2, 3.4)
        m.put(objects.ceiling_panel(2.6, 1.2, 0.6, 2.3), x0 + 2.3, 3.8)


def _archive(m: Model) -> None:
    steel = f.enamel((0.5, 0.55, 0.58), 6, 0.25)
    for k, x in enumerate((1.5, 4.4)):
        m.put(pieces.library_shelf(1.9, 2.1, steel, 80 + 4 * k, 2.6), x, -2.3, 0, 90.0)
    m.put(pieces.bookshelf(2.4, 2.1, steel, 90, thickness=2.6), 6.4, -1.9, 0, "w")
    m.put(pieces.filing_cabinet(1), 3.5, -3.4, 0, "n")
    m.put(pieces.filing_cabinet(2), 2.5, -3.4, 0, "n")
    m.put(pieces.copier(), 0.0, -0.9, 0, "e")
    for k in range(3):
        m.put(objects.carton(k, 0.4, 0.35, 0.32), 0.35, -3.0 + 0.02 * k, 0.32 * k, 10.0 * k)
    m.put(objects.picture("poster", 140, 0.5, 0.7, 1.85), 3.0, -3.4, 0, "n")
    m.put(objects.ceiling_panel(2.6, 1.2, 0.3, 2.2), 2.5, -2.0)
    m.put(objects.ceiling_panel(2.6, 1.2, 0.3, 2.2), 5.2, -1.6)


def _lounge(m: Model) -> None:
    pillows = (f.fabric(f.MUSTARD, 6), f.striped((f.TEAL, f.CREAM), 14))
    m.put(pieces.sofa(2.2, f.fabric((0.32, 0.42, 0.4), 6), pillows, 4), 6.52, -2.2, 0, "e")
    m.put(objects.rug(2.4, 1.7, PERSIAN, 25), 8.6, -2.2)
    m.put(pieces.coffee_table(f.wood(f.WALNUT, 12), 9), 8.1, -2.2, 0, "e")
    m.put(pieces.armchair(f.leather((0.5, 0.3, 0.2), 9), f.fabric(f.CREAM, 4)), 8.2, -0.2, 0, 180.0)
    m.put(pieces.meeting_table(2.0, 1.0, 3, 2), 12.3, -1.9)
    m.put(objects.pendant(2.6, 0.45, 0.28, 1, 2.4), 12.3, -1.9)
    m.put(objects.pendant(2.6, 0.45, 0.28, 2, 2.4), 8.6, -2.0)
    m.put(
        objects.curtains(2.4, 2.4, f.printed(f.CREAM, (f.TERRACOTTA, f.SAGE), "damask", 23)),
        9.0,
        -3.4,
        0,
        "n",
    )
    m.put(objects.board("white", 1.8, 1.1, 1.5, 35), 14.0, -1.9, 0, "w")
    m.put(objects.picture_group(142, 1.7), 6.52, -2.2, 0, "e")
    m.put(objects.floor_lamp(0), 6.9, -0.6)
    m.put(objects.leafy_plant(1.5, 2, 44), 7.0, -2.95)
    m.put(objects.picture("sunset", 147, 1.0, 0.7), 12.3, -3.4, 0, "n")
    m.put(pieces.sideboard(1.3, f.wood(f.WALNUT, 13), 11), 13.2, -0.12, 0, "s")


def build() -> World:
    """Makes the corridor."""
    m = plan().build()
    for furnish in (_corridor, _offices, _archive, _lounge):
        furnish(m)
    return assemble("corridor", m, (5.6, 0.95, 1.3), 0.0, SUMMARY)
