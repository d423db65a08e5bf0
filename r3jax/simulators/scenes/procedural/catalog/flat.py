"""The flat: one room with bed, sofa and kitchenette, a hall and a bathroom. The demo's scene."""

from r3jax.simulators.scenes.procedural.floorplan import FloorPlan
from r3jax.simulators.scenes.procedural.furniture import kitchen, objects, pieces
from r3jax.simulators.scenes.procedural.materials import finishes as f
from r3jax.simulators.scenes.procedural.materials.finishes import LEAFY, PERSIAN
from r3jax.simulators.scenes.procedural.model import Model, assemble
from r3jax.simulators.world import World

SUMMARY = "one-room flat with kitchenette, hall and bathroom, 34 m2"


def plan() -> FloorPlan:
    """Lays out rooms, doorways and windows."""
    drawn, white, oak = FloorPlan(), f.enamel(f.WHITE, 3, 0.2), f.plank_floor(f.OAK, 4)
    ceiling = f.plaster((0.93, 0.92, 0.9), 50, 0.7)
    drawn.room(
        "living",
        (0, 0, 5.6, 4.2),
        wall=f.plaster((0.86, 0.82, 0.73), 1),
        floor=oak,
        ceiling=ceiling,
        skirting=white,
        sides={
            "w": f.wallpaper(f.CREAM, LEAFY, "botanical", 6),
            "n": f.plaster((0.62, 0.69, 0.64), 9),
        },
    )
    drawn.room(
        "bath",
        (5.72, 2.0, 8.2, 4.2),
        wall=f.plaster((0.85, 0.87, 0.86), 3),
        floor=f.tiled(((0.88, 0.87, 0.84), (0.24, 0.27, 0.3)), 12, 6, 6, 0.25, 0.0, 0.08),
        ceiling=ceiling,
        wainscot=(
            2.0,
            f.tiled(((0.88, 0.9, 0.9), (0.8, 0.86, 0.87), (0.6, 0.72, 0.75)), 11, 8, 8, 0.2),
        ),
    )
    trellis = ((0.74, 0.67, 0.56), (0.55, 0.4, 0.3))
    drawn.room(
        "hall",
        (5.72, 0, 8.2, 1.88),
        wall=f.wallpaper((0.85, 0.8, 0.7), trellis, "trellis", 8),
        floor=oak,
        ceiling=ceiling,
        skirting=white,
    )
    drawn.doorway("x", (5.6, 5.72), 0.95)
    drawn.doorway("y", (1.88, 2.0), 6.5)
    drawn.window("living", "w", 2.15, 1.6, 0.85, 2.2, 3)
    drawn.window("living", "s", 2.3, 1.5, 0.85, 2.2, 7)
    drawn.window("bath", "e", 3.1, 0.8, 1.2, 2.0, 5)
    return drawn


def _sleep_and_work(m: Model) -> None:
    oak, pine = f.wood(f.OAK, 1), f.wood(f.PINE, 2)
    cover = f.printed(f.CREAM, (f.NAVY, f.SAGE, f.TERRACOTTA), "damask", 3)
    m.put(
        pieces.bed(1.4, cover, f.plaid(f.MUSTARD, f.CREAM, f.TERRACOTTA, 5), oak),
        1.25,
        4.2,
        0,
        "s",
    )
    m.put(pieces.nightstand(oak, 2), 2.3, 4.2, 0, "s")
    m.put(pieces.desk(1.1, pine, 6), 0.0, 0.75, 0, "e")
    m.put(pieces.chair(pine, f.fabric(f.TERRACOTTA, 1)), 0.85, 0.75, 0, 80.0)
    m.put(pieces.bookshelf(1.0, 2.0, f.wood(f.OAK, 3), 11), 5.6, 2.15, 0, "w")
    m.put(objects.leafy_plant(1.1, 3), 0.43, 2.93)
    m.put(objects.picture_group(10, 1.75), 1.3, 4.2, 0, "s")
    m.put(objects.pendant(2.6, 0.5, 0.24, 1), 2.6, 2.3)


def _sit_and_cook(m: Model) -> None:
    accents = (
        f.striped((f.MUSTARD, f.CREAM), 2),
        f.printed(f.CREAM, (f.TERRACOTTA, f.TEAL), "trellis", 4),
    )
    m.put(pieces.sofa(1.9, f.fabric((0.38, 0.46, 0.52), 3), accents, 1), 2.5, 0.12, 0, "n")
    m.put(objects.rug(2.0, 1.3, PERSIAN, 5), 2.5, 1.75)
    m.put(pieces.coffee_table(f.wood(f.WALNUT, 2), 3, 0.9), 2.5, 1.55)
    m.put(objects.floor_lamp(0), 3.75, 0.35)
    drapes = f.striped((f.CREAM, f.SAGE, f.CREAM, f.TERRACOTTA), 8)
    m.put(objects.curtains(1.5, 2.35, drapes), 2.3, 0.0, 0, "n")
    m.put(objects.picture("sunset", 21, 0.7, 0.5), 4.4, 0.0, 0, "n")
    splash = f.tiled((f.WHITE, f.SAGE, f.MUSTARD, f.CREAM), 17, 12, 12, 0.1)
    front = f.enamel((0.32, 0.43, 0.42), 2, 0.3)
    m.put(kitchen.kitchen_run(2.4, front, f.wood(f.BEECH, 5, 0.3), splash, 4), 4.25, 4.2, 0, "s")
    m.put(objects.clock(3, 2.0), 5.6, 3.3, 0, "w")
    m.put(objects.pendant(2.6, 0.45, 0.16, 5, 1.6), 4.4, 3.0)


def _bath_and_hall(m: Model) -> None:
    m.put(kitchen.toilet(), 7.75, 4.2, 0, "s")
    m.put(kitchen.washbasin(0.9, f.wood(f.OAK, 6), 3), 5.72, 3.35, 0, "e")
    m.put(kitchen.towel_rail(4), 8.2, 2.4, 0, "w")
    m.put(objects.ceiling_panel(2.6, 0.5, 0.5, 2.0), 6.9, 3.1)
    m.put(objects.coat_rack(1), 7.6, 1.88, 0, "s")
    m.put(pieces.drawers(0.9, 0.85, 0.35, f.wood(f.WALNUT, 5), 2, 3), 8.2, 0.9, 0, "w")
    m.put(objects.vase(5), 8.0, 1.15, 0.85)
    m.put(objects.clutter(14), 8.0, 0.65, 0.85)
    m.put(objects.wall_mirror(0.6, 0.9, 1.5), 8.2, 0.9, 0, "w")
    m.put(objects.picture("poster", 8, 0.5, 0.7), 6.6, 0.0, 0, "n")
    m.put(objects.pendant(2.6, 0.3, 0.15, 3, 1.7), 6.8, 0.95)


def build() -> World:
    """Makes the flat."""
    m = plan().build()
    _sleep_and_work(m)
    _sit_and_cook(m)
    _bath_and_hall(m)
    return assemble("flat", m, (3.9, 2.2, 1.3), 160.0, SUMMARY)
