"""Furniture: to keep things in, to sit and lie on, to eat and work at; offices and classrooms."""

import numpy as np

from r3jax.simulators.scenes.procedural.furniture import objects, pieces
from r3jax.simulators.scenes.procedural.materials import finishes as f
from r3jax.simulators.scenes.procedural.materials.textures import Real
from r3jax.simulators.scenes.procedural.model import Finish, Model
from r3jax.simulators.scenes.procedural.shapes import (
    ball,
    box,
    combine,
    cushion,
    cylinder,
    drape,
    lathe,
    panel,
    quad,
    tube,
)


def bookshelf(
    width: Real, height: Real, wood: Finish, seed: int, depth: Real = 0.3, thickness: Real = 1.0
) -> Model:
    """Builds an open shelf full of books (`thickness` 2: binders), with objects in between."""
    rng = np.random.default_rng(seed)
    w, t = width / 2, 0.022
    floors = max(2, round(height / 0.36))
    pitch = (height - 0.08 - t) / floors
    boards = [
        box((-w, 0, 0), (-w + t, depth, height)),
        box((w - t, 0, 0), (w, depth, height)),
        box((-w + t, 0, 0.08), (w - t, 0.012, height)),
    ]
    for k in range(floors + 1):
        z = 0.08 + k * pitch
        boards.append(box((-w + t, 0.012, z), (w - t, depth - 0.005, z + t)))
    model = Model().add(combine(boards), wood)
    for k in range(floors):
        z, free = 0.08 + k * pitch + t, pitch - t - 0.02
        split = (0.6 + 0.36 * rng.random()) * (width - 2 * t)
        left = rng.random() < 0.5
        x0, x1 = (-w + t, -w + t + split) if left else (w - t - split, w - t)
        seeds = rng.integers(0, 1000, 4)
        model.put(
            objects.book_row(x1 - x0, free, depth - 0.05, int(seeds[0]), thickness), x0, 0.012, z
        )
        r0, r1 = (x1, w - t) if left else (-w + t, x0)
        for i in range(int((r1 - r0) / 0.2)):
            x = r0 + (i + 0.5) * (r1 - r0) / int((r1 - r0) / 0.2)
            model.put(objects.clutter(int(seeds[i % 4]) + i), x, depth / 2, z, 15.0 * rng.normal())
    return model


def library_shelf(
    width: Real, height: Real, wood: Finish, seed: int, thickness: Real = 1.0
) -> Model:
    """Builds two bookshelves back to back, origin in the middle, with end panels."""
    model = Model()
    model.put(bookshelf(width, height, wood, seed, 0.28, thickness), 0, 0.01, 0, "n")
    model.put(bookshelf(width, height, wood, seed + 1, 0.28, thickness), 0, -0.01, 0, "s")
    for x in (-width / 2 - 0.02, width / 2):
        model.add(box((x, -0.31, 0), (x + 0.02, 0.31, height + 0.05)), wood)
    return model


def _handle(x: Real, z: Real, y: Real, length: Real = 0.14, upright: bool = True):
    a, b = (
        ((x, y, z - length / 2), (x, y, z + length / 2))
        if upright
        else ((x - length / 2, y, z), (x + length / 2, y, z))
    )
    foot_a, foot_b = (a[0], y - 0.03, a[2]), (b[0], y - 0.03, b[2])
    return tube([foot_a, a, b, foot_b], 0.006)


def wardrobe(width: Real, height: Real, wood: Finish, mirror: bool = True) -> Model:
    """Builds a wardrobe with panelled doors; one of them may carry a mirror. 0.6 m deep."""
    model = Model().add(box((-width / 2, 0, 0), (width / 2, 0.57, height), step=0.5), wood)
    doors = max(2, round(width / 0.5))
    pitch = width / doors
    for k in range(doors):
        x0, x1 = -width / 2 + k * pitch + 0.004, -width / 2 + (k + 1) * pitch - 0.004
        model.add(box((x0, 0.57, 0.08), (x1, 0.59, height - 0.02)), wood, (0.95, 0.95, 0.95))
        middle = (x0 + x1) / 2
        if mirror and k == doors // 2:
            model.add(panel(middle, 0.2, pitch - 0.1, height - 0.35, 0.593), f.mirror())
        else:
            for z0, z1 in ((0.18, 0.85), (0.95, height - 0.12)):
                model.add(box((x0 + 0.07, 0.59, z0), (x1 - 0.07, 0.6, z1)), wood)
        model.add(_handle(x1 - 0.04 if k % 2 == 0 else x0 + 0.04, 1.05, 0.63), f.metal())
    return model


def drawers(
    width: Real, height: Real, depth: Real, finish: Finish, columns: int, rows: int
) -> Model:
    """Builds a chest of drawers (or a sideboard) on a plinth."""
    w = width / 2
    model = Model().add(box((-w, 0, 0.07), (w, depth, height), step=0.5), finish)
    model.add(box((-w + 0.03, 0.03, 0), (w - 0.03, depth - 0.05, 0.07)), f.wood(f.EBONY, 1))
    for i in range(columns):
        for j in range(rows):
            x0 = -w + 0.02 + i * (width - 0.04) / columns
            x1 = x0 + (width - 0.04) / columns - 0.012
            z0 = 0.09 + j * (height - 0.13) / rows
            z1 = z0 + (height - 0.13) / rows - 0.012
            model.add(box((x0, depth, z0), (x1, depth + 0.018, z1)), finish, (0.93, 0.93, 0.93))
            model.add(
                _handle((x0 + x1) / 2, (z0 + z1) / 2, depth + 0.05, 0.12, False),
                f.metal((0.66, 0.56, 0.4), 2),
            )
    return model


def sideboard(width: Real, wood: Finish, seed: int) -> Model:
    """Builds a sideboard with a lamp and things on it."""
    model = Model().put(drawers(width, 0.8, 0.42, wood, max(2, round(width / 0.5)), 3))
    model.put(objects.table_lamp(seed), -width / 2 + 0.25, 0.2, 0.8)
    things = (
        objects.vase(seed + 1),
        objects.book_pile(4, seed),
        objects.standing_frame(seed),
        objects.leafy_plant(0.4, seed, 22),
    )
    for k, thing in enumerate(things):
        model.put(thing, -width / 2 + 0.62 + k * (width - 0.85) / 3, 0.22, 0.8, -8.0 * k)
    return model


def nightstand(wood: Finish, seed: int) -> Model:
    """Builds a bedside table with a lamp and books."""
    model = Model().put(drawers(0.45, 0.5, 0.38, wood, 1, 2))
    model.put(objects.table_lamp(seed, 0.4), -0.08, 0.16, 0.5)
    return model.put(objects.book_pile(2, seed), 0.1, 0.26, 0.5, 10.0)


def television_unit(width: Real, wood: Finish, seed: int) -> Model:
    """Builds a low unit with a large screen, speakers and boxes."""
    model = Model().put(drawers(width, 0.45, 0.4, wood, 3, 1))
    dark = f.enamel(f.CHARCOAL, 2, 0.5)
    model.add(box((-0.62, 0.12, 0.55), (0.62, 0.16, 1.27)), dark)
    model.add(panel(0, 0.57, 1.2, 0.68, 0.163), f.picture("sunset", 50 + seed, True))
    model.add(box((-0.2, 0.06, 0.45), (0.2, 0.26, 0.465)), dark)
    model.add(box((-0.03, 0.1, 0.46), (0.03, 0.13, 0.56)), dark)
    for x in (-width / 2 + 0.13, width / 2 - 0.13):
        model.add(box((x - 0.1, 0.05, 0.45), (x + 0.1, 0.27, 0.8)), f.wood(f.WALNUT, 3))
        for z, r in ((0.55, 0.07), (0.7, 0.045)):
            cone = cylinder(r, 0.0, 0.012, 16, 0.7 * r).turned(-90.0, "x")
            model.add(cone.moved(x, 0.27, z), dark)
    return model


def monitor(seed: int, width: Real = 0.55) -> Model:
    """Builds a monitor on its foot; screen towards +y, origin below it."""
    dark, w = f.enamel(f.CHARCOAL, 2, 0.4), width / 2
    model = Model().add(box((-0.12, -0.08, 0), (0.12, 0.08, 0.012)), dark)
    model.add(box((-0.025, -0.045, 0.01), (0.025, -0.025, 0.3)), dark)
    model.add(box((-w, -0.025, 0.12), (w, 0.0, 0.12 + 0.62 * width)), dark)
    return model.add(panel(0, 0.13, width - 0.02, 0.62 * width - 0.02, 0.002), f.screen(seed % 5))


def desk(width: Real, wood: Finish, seed: int, monitors: int = 1) -> Model:
    """Builds a desk against a wall, 0.75 m deep.

    It carries monitors, a keyboard, papers, pots and a drawer block.
    """
    w, rng = width / 2, np.random.default_rng(seed)
    model = Model().add(box((-w, 0, 0.71), (w, 0.75, 0.74), step=0.4), wood)
    steel = f.metal((0.4, 0.41, 0.43), 3, 0.05)
    for x in (-w + 0.03, w - 0.08):
        model.add(box((x, 0.05, 0), (x + 0.05, 0.7, 0.03)), steel)
        model.add(box((x, 0.3, 0.03), (x + 0.05, 0.4, 0.71)), steel)
    model.put(drawers(0.4, 0.6, 0.5, f.enamel(f.WHITE, 5, 0.2), 1, 3), -w + 0.34, 0.1)
    for k in range(monitors):
        x = (k - (monitors - 1) / 2) * 0.58 + 0.08
        model.put(monitor(seed + k), x, 0.2, 0.74, -9.0 * (k - (monitors - 1) / 2) * 2)
    model.add(quad((-0.15, 0.42, 0.756), (0.44, 0, 0), (0, 0.15, 0)), f.keyboard())
    model.add(box((-0.15, 0.42, 0.741), (0.29, 0.57, 0.755)), f.enamel(f.CHARCOAL, 2))
    for k in range(3):
        sheet = box((-0.105, -0.148, 0), (0.105, 0.148, 0.004 * (k + 1)))
        paper = Model().add(sheet, f.picture("poster", 60 + (seed + k) % 4))
        model.put(
            paper, w - 0.3 + 0.04 * k, 0.35 + 0.05 * k, 0.741 + 0.004 * k, float(rng.normal(0, 25))
        )
    model.put(objects.table_lamp(seed, 0.42), w - 0.16, 0.14, 0.74)
    pot = Model().add(cylinder(0.04, 0, 0.1, 12, 0.042), f.striped((f.TEAL, f.CREAM), 4))
    for k in range(5):
        pen = tube([(0, 0, 0.02), (0.02 * np.cos(k), 0.02 * np.sin(k), 0.17)], 0.004, 5)
        pot.add(pen, f.enamel((f.TERRACOTTA, f.NAVY, f.MUSTARD)[k % 3], 1))
    model.put(pot, -w + 0.2, 0.14, 0.74)
    return model.put(objects.book_pile(4, seed), -w + 0.22, 0.46, 0.74, 12.0)


def glass_partition(width: Real, height: Real) -> Model:
    """Builds a framed glass wall, 8 cm thick, in its middle plane y = 0.

    The panes between the posts are clear glass (no depth there, half a mirror) with an etched
    band at half height, as is required where people could walk into them.
    """
    frame = f.metal((0.3, 0.31, 0.33), 3, 0.05)
    bays = max(1, round(width / 1.1))
    bars = [
        box((-width / 2, -0.04, 0), (width / 2, 0.04, 0.1)),
        box((-width / 2, -0.04, height - 0.08), (width / 2, 0.04, height)),
        box((-width / 2, -0.035, 0.78), (width / 2, 0.035, 0.83)),
    ]
    for x in np.linspace(-width / 2 + 0.03, width / 2 - 0.03, bays + 1):
        bars.append(box((x - 0.03, -0.04, 0.1), (x + 0.03, 0.04, height - 0.08)))
    model = Model().add(combine(bars), frame)
    for low, high, finish in (
        (0.1, 0.78, f.frosted()),
        (0.83, 1.2, f.glass()),
        (1.2, 1.45, f.frosted(8)),
        (1.45, height - 0.08, f.glass()),
    ):
        pane = box((-width / 2, -0.005, low), (width / 2, 0.005, high), upright=True)
        model.add(pane, finish)
    return model


def workstation(seed: int, width: Real = 1.5) -> Model:
    """Builds a desk with a chair, monitors and personal things."""
    model = pieces.desk(width, f.wood(f.BEECH if seed % 2 else f.OAK, seed % 3), seed, 1 + seed % 2)
    cloth = f.fabric((f.CHARCOAL, f.TEAL, f.NAVY, f.TERRACOTTA)[seed % 4], seed % 3)
    chair = office_chair(cloth)
    turn = float(np.random.default_rng(seed).normal(0, 25))
    return model.put(chair, 0.05, 1.0, 0, 180.0 + turn)


def desk_island(pairs: int, seed: int) -> Model:
    """Builds workstations face to face with a pinboard screen between; origin in the middle."""
    model, length = Model(), pairs * 1.5
    for k in range(pairs):
        x = (k + 0.5) * 1.5 - length / 2
        model.put(workstation(seed + 2 * k), x, 0.03, 0, "n")
        model.put(workstation(seed + 2 * k + 1), x, -0.03, 0, "s")
    screen = box((-length / 2, -0.02, 0.72), (length / 2, 0.02, 1.12), upright=True)
    return model.add(screen, f.fabric(f.SAGE if seed % 2 else f.NAVY, 2))


def meeting_table(width: Real, depth: Real, seats: int, seed: int) -> Model:
    """Builds a conference table with swivel chairs, papers, cups and a conference phone."""
    model = Model().put(table(width, depth, f.wood(f.WALNUT, 4, 0.35), 0.74))
    for k in range(seats):
        x = (k + 0.5) * width / seats - width / 2
        for side, heading in ((-1, 0.0), (1, 180.0)):
            chair = office_chair(f.leather((0.2, 0.19, 0.19), 2))
            model.put(chair, x, side * (depth / 2 + 0.28), 0, heading + 14.0 * ((k + seed) % 3 - 1))
            paper = Model().add(
                box((-0.105, -0.148, 0), (0.105, 0.148, 0.005)), f.picture("poster", 60 + k % 4)
            )
            model.put(paper, x, side * (depth / 2 - 0.22), 0.741, heading + 7.0 * k)
            model.put(
                objects.crockery(k + seed), x + 0.25, side * (depth / 2 - 0.25), 0.741, heading
            )
    phone = cylinder(0.12, 0.0, 0.05, 3, 0.06)
    return model.add(phone.moved(0, 0, 0.74), f.enamel(f.CHARCOAL, 1))


def filing_cabinet(seed: int) -> Model:
    """Builds a steel cabinet with boxes and a plant on it."""
    color = (f.SAGE, (0.55, 0.57, 0.6), f.MUSTARD)[seed % 3]
    model = Model().put(pieces.drawers(0.8, 1.15, 0.45, f.enamel(color, 4, 0.3), 1, 4))
    model.put(objects.carton(seed, 0.3, 0.25, 0.26), -0.2, 0.2, 1.15, 6.0)
    return model.put(objects.leafy_plant(0.5, seed, 26), 0.2, 0.2, 1.15)


def copier() -> Model:
    """Builds a floor-standing copier."""
    white, dark = f.enamel((0.86, 0.86, 0.84), 5, 0.3), f.enamel(f.CHARCOAL, 2, 0.4)
    model = Model().add(box((-0.3, 0.02, 0.04), (0.3, 0.62, 0.82)), white)
    model.add(box((-0.32, 0, 0.82), (0.32, 0.6, 0.9)), dark)
    model.add(box((-0.3, 0.02, 0.9), (0.3, 0.6, 1.02)), white)
    for z in (0.12, 0.34, 0.56):
        model.add(box((-0.27, 0.62, z), (0.27, 0.64, z + 0.18)), white, (0.9, 0.9, 0.9))
    model.add(box((-0.62, 0.12, 0.7), (-0.3, 0.5, 0.72)), dark)
    model.add(quad((-0.6, 0.15, 0.722), (0.21, 0, 0), (0, 0.3, 0)), f.picture("poster", 61))
    return model.add(quad((0.02, 0.46, 1.025), (0.24, 0, 0), (0, 0.13, 0)), f.screen(3))


def water_cooler() -> Model:
    """Builds a water cooler with its bottle."""
    model = Model().add(box((-0.16, 0.02, 0), (0.16, 0.34, 1.0)), f.enamel(f.WHITE, 6, 0.4))
    model.add(cylinder(0.13, 1.0, 1.36, 18).moved(0, 0.18), f.enamel((0.45, 0.65, 0.8), 3, 0.9))
    return model.add(panel(0, 0.62, 0.24, 0.25, 0.342), f.package(3))


def school_desk(seed: int) -> Model:
    """Builds a desk for two with chairs, books and pencils; origin in its middle.

    The pupils sit on the +y side and look towards -y.
    """
    model = Model().put(table(1.2, 0.5, f.wood(f.BEECH, seed % 3), 0.72))
    tint = (f.TEAL, f.TERRACOTTA, f.MUSTARD, f.NAVY)[seed % 4]
    for k, x in enumerate((-0.3, 0.3)):
        seat = chair(f.metal((0.4, 0.41, 0.43), 3, 0.05), f.enamel(tint, 2, 0.3))
        model.put(seat, x, 0.42, 0, 180.0 + 8.0 * ((seed + k) % 3 - 1))
        if (seed + k) % 3:
            model.put(objects.book_pile(1 + (seed + k) % 3, seed + k), x, 0.03, 0.72, 14.0 * k)
        sheet = Model().add(
            box((-0.1, -0.14, 0), (0.1, 0.14, 0.004)), f.picture("poster", 60 + (seed + k) % 4)
        )
        model.put(sheet, x + 0.16, 0.05, 0.721, -12.0 * seed)
    return model


def globe(seed: int) -> Model:
    """Builds a globe on a stand."""
    model = Model().add(cylinder(0.1, 0, 0.03, 16), f.wood(f.WALNUT, 2))
    model.add(tube([(0, 0, 0.03), (0, 0, 0.12)], 0.012), f.metal((0.7, 0.58, 0.35), 2))
    sphere = ball((0.15, 0.15, 0.15), 18, 12).turned(23.0, "x").moved(z=0.27)
    return model.add(sphere, f.picture("landscape", 80 + seed, True))


def spotlight_rail(length: Real, ceiling: Real, count: int, reach: Real = 2.2) -> Model:
    """Builds a rail along x under the ceiling with spotlights that shine downwards."""
    dark = f.enamel(f.CHARCOAL, 1)
    model = Model().add(
        box((-length / 2, -0.02, ceiling - 0.04), (length / 2, 0.02, ceiling)), dark
    )
    for x in np.linspace(-length / 2 + 0.3, length / 2 - 0.3, count):
        can = cylinder(0.035, -0.16, 0.0, 12, 0.05).turned(18.0, "x")
        model.add(can.moved(float(x), 0.0, ceiling - 0.05), dark)
        bulb = ball((0.03, 0.03, 0.012), 10, 4).moved(float(x), 0.05, ceiling - 0.21)
        model.add(bulb, f.glow((1.0, 0.97, 0.9), 6, 1.0))
        model.light((float(x), 0.1, ceiling - 0.3), reach, (0.6, 0.56, 0.48))
    return model


def lectern(wood: Finish) -> Model:
    """Builds a teacher's desk with a globe, books and a chair behind it; front towards +y."""
    model = Model().put(pieces.drawers(0.45, 0.7, 0.55, wood, 1, 3), -0.5, -0.3)
    model.put(table(1.5, 0.7, wood, 0.76))
    model.put(globe(1), 0.55, 0.1, 0.76)
    model.put(objects.book_pile(5, 4), -0.5, 0.1, 0.76, 25.0)
    model.put(objects.book_pile(3, 9), 0.1, -0.1, 0.76)
    return model.put(chair(wood, f.leather((0.4, 0.22, 0.15), 1)), 0.0, -0.6, 0, 12.0)


def _legs(width: Real, depth: Real, height: Real, finish: Finish, thick: Real = 0.045) -> Model:
    model = Model()
    for x in (-width / 2 + thick, width / 2 - thick):
        for y in (-depth / 2 + thick, depth / 2 - thick):
            leg = cylinder(0.35 * thick, 0.0, height, 8, 0.55 * thick)
            model.add(leg.moved(x, y), finish)
    return model


def sofa(width: Real, cloth: Finish, accents: tuple[Finish, ...], seed: int = 0) -> Model:
    """Builds a sofa with seat, back and loose cushions; 0.9 m deep, back on y = 0."""
    arm, seats = 0.18, max(1, round((width - 0.36) / 0.75))
    model = Model().put(_legs(width - 0.1, 0.75, 0.12, f.wood(f.WALNUT, 2)), 0, 0.45)
    model.add(box((-width / 2 + 0.04, 0.03, 0.1), (width / 2 - 0.04, 0.86, 0.28)), cloth)
    for side in (-1, 1):
        x = side * (width / 2 - arm / 2)
        model.add(cushion((x - arm / 2, 0.0, 0.08), (x + arm / 2, 0.9, 0.62), 0.3), cloth)
    inner = width - 2 * arm
    for k in range(seats):
        x0 = -inner / 2 + k * inner / seats
        x1 = x0 + inner / seats
        model.add(cushion((x0, 0.12, 0.24), (x1, 0.9, 0.46), 0.3), cloth)
        back = cushion((x0, -0.1, -0.26), (x1, 0.1, 0.26), 0.34).turned(12.0, "x")
        model.add(back.moved(0, 0.2, 0.64), cloth)
    rng = np.random.default_rng(seed)
    for k, accent in enumerate(accents):
        x = (-1) ** k * (inner / 2 - 0.2 - 0.32 * (k // 2))
        pillow = cushion((-0.21, -0.07, -0.21), (0.21, 0.07, 0.21), 0.5)
        pillow = pillow.turned(22.0, "x").turned(float(rng.normal(0, 12)))
        model.add(pillow.moved(x, 0.42, 0.64), accent)
    return model


def armchair(cloth: Finish, accent: Finish) -> Model:
    """Builds a small sofa for one with a blanket over its arm."""
    model = sofa(0.95, cloth, (accent,))
    throw = drape((0.29, 0.2, 0.0), (0.48, 0.75, 0.625), 0.28)
    return model.add(throw, f.plaid(f.CREAM, f.TERRACOTTA, f.CHARCOAL, 2))


def chair(wood: Finish, seat: Finish) -> Model:
    """Builds a dining chair, origin in its middle, front towards +y."""
    model = Model().put(_legs(0.44, 0.44, 0.44, wood, 0.05))
    model.add(cushion((-0.22, -0.21, 0.42), (0.22, 0.23, 0.5), 0.3), seat)
    for x in (-0.19, 0.19):
        model.add(tube([(x, -0.2, 0.44), (x, -0.22, 0.7), (x, -0.27, 0.92)], 0.017), wood)
    for z in (0.62, 0.74, 0.86):
        y = -0.215 - 0.05 * (z - 0.6) / 0.3
        model.add(box((-0.18, y - 0.012, z), (0.18, y + 0.012, z + 0.06)), wood)
    return model


def stool(wood: Finish, height: Real = 0.65) -> Model:
    """Builds a bar stool with a foot ring."""
    model = Model().put(_legs(0.34, 0.34, height - 0.04, wood))
    model.add(cylinder(0.18, height - 0.04, height, 18), wood)
    ring = [(0.15 * np.cos(a), 0.15 * np.sin(a), 0.22) for a in np.linspace(0, 2 * np.pi, 13)]
    return model.add(tube(ring, 0.01), f.metal())


def table(width: Real, depth: Real, wood: Finish, height: Real = 0.74) -> Model:
    """Builds a four-legged table, origin in its middle."""
    model = Model()
    model.add(
        box((-width / 2, -depth / 2, height - 0.035), (width / 2, depth / 2, height), step=0.4),
        wood,
    )
    w, d = width / 2 - 0.06, depth / 2 - 0.06
    model.add(box((-w, -d, height - 0.11), (w, d, height - 0.036)), wood)
    for x in (-w, w):
        for y in (-d, d):
            model.add(box((x - 0.03, y - 0.03, 0), (x + 0.03, y + 0.03, height - 0.036)), wood)
    return model


def dining_set(width: Real, depth: Real, wood: Finish, seat: Finish, seed: int) -> Model:
    """Builds a laid table with chairs on both long sides."""
    rng = np.random.default_rng(seed)
    model = Model().put(table(width, depth, wood))
    runner = drape((-0.18, -depth / 2, 0.0), (0.18, depth / 2, 0.74), 0.001, 0.0)
    model.add(runner, f.striped((f.CREAM, f.TERRACOTTA, f.CREAM, f.NAVY), 6))
    places = max(1, int(width / 0.6))
    for k in range(places):
        x = (k + 0.5) * width / places - width / 2
        for side, heading in ((-1, 0.0), (1, 180.0)):
            away = depth / 2 + 0.1 + 0.1 * rng.random()
            model.put(chair(wood, seat), x, side * away, 0, heading + 9.0 * rng.normal())
            model.put(objects.crockery(k), x, side * (depth / 2 - 0.17), 0.741, heading)
    model.put(objects.bowl_of_fruit(seed), 0.0, 0.0, 0.755)
    return model.put(objects.vase(seed, 0.3), 0.24 * width, 0.03, 0.741)


def coffee_table(wood: Finish, seed: int, width: Real = 1.0) -> Model:
    """Builds a low table with books, a bowl and a cup; origin in its middle."""
    model = Model().put(table(width, 0.55, wood, 0.4))
    model.add(box((-width / 2 + 0.08, -0.2, 0.14), (width / 2 - 0.08, 0.2, 0.16)), wood)
    model.put(objects.book_pile(4, seed), -0.25 * width, 0.02, 0.4, 20.0)
    model.put(objects.book_pile(3, seed + 1), 0.1, 0.0, 0.16)
    model.put(objects.bowl_of_fruit(seed), 0.08, -0.06, 0.4)
    return model.put(objects.crockery(seed), 0.32 * width, 0.06, 0.4)


def bed(width: Real, cover: Finish, throw: Finish, wood: Finish, length: Real = 2.0) -> Model:
    """Builds a bed with mattress, duvet, throw and pillows; head on y = 0."""
    w, model = width / 2, Model()
    model.add(box((-w - 0.05, 0, 0), (w + 0.05, 0.06, 1.05), step=0.5), wood)
    model.add(box((-w - 0.03, 0.06, 0.1), (w + 0.03, length + 0.04, 0.3)), wood)
    for x in (-w, w - 0.06):
        model.add(box((x, length - 0.08, 0), (x + 0.06, length, 0.1)), wood)
    linen = f.striped((f.WHITE, (0.84, 0.86, 0.88)), 2, 8)
    model.add(cushion((-w, 0.06, 0.27), (w, length, 0.52), 0.22), linen)
    model.add(drape((-w, 0.62, 0), (w, length + 0.01, 0.535), 0.26), cover)
    model.add(drape((-w, 1.3, 0), (w, 1.75, 0.562), 0.32), throw)
    for k, x in enumerate((-w / 2, w / 2) if width > 1.2 else (0.0,)):
        pillow = cushion((-0.33, -0.2, -0.08), (0.33, 0.2, 0.08), 0.5).turned(28.0, "x")
        model.add(pillow.moved(x, 0.3, 0.64), linen)
        small = cushion((-0.2, -0.06, -0.18), (0.2, 0.06, 0.18), 0.5).turned(30.0, "x")
        model.add(small.moved(x * 0.8, 0.52, 0.7), throw if k else cover)
    return model


def bench(width: Real, wood: Finish, cloth: Finish) -> Model:
    """Builds an upholstered bench, origin in its middle."""
    model = Model().put(_legs(width, 0.42, 0.36, wood))
    model.add(box((-width / 2, -0.2, 0.34), (width / 2, 0.2, 0.38)), wood)
    return model.add(cushion((-width / 2, -0.21, 0.37), (width / 2, 0.21, 0.46), 0.25), cloth)


def office_chair(cloth: Finish) -> Model:
    """Builds a swivel chair on five castors, origin in its middle, front towards +y."""
    dark = f.enamel(f.CHARCOAL, 1)
    arms = [
        tube([(0, 0, 0.1), (0.3 * np.cos(a), 0.3 * np.sin(a), 0.06)], 0.02)
        for a in np.linspace(0, 2 * np.pi, 6)[:-1]
    ]
    wheels = [
        cylinder(0.035, 0.0, 0.06, 8).moved(0.3 * np.cos(a), 0.3 * np.sin(a))
        for a in np.linspace(0, 2 * np.pi, 6)[:-1]
    ]
    model = (
        Model().add(combine(arms + wheels), dark).add(cylinder(0.028, 0.08, 0.43, 10), f.metal())
    )
    model.add(cushion((-0.25, -0.24, 0.42), (0.25, 0.26, 0.52), 0.35), cloth)
    back = cushion((-0.23, -0.04, 0), (0.23, 0.04, 0.56), 0.35).turned(8.0, "x")
    model.add(back.moved(0, -0.24, 0.58), cloth)
    model.add(tube([(0, -0.1, 0.42), (0, -0.3, 0.45), (0, -0.3, 0.7)], 0.02), dark)
    for x in (-0.27, 0.27):
        model.add(tube([(x, -0.15, 0.47), (x, -0.15, 0.68), (x, 0.12, 0.7)], 0.016), dark)
    return model


def plinth_sculpture(seed: int, stone: Finish) -> Model:
    """Builds a turned or knotted sculpture on a plinth, origin in its middle."""
    model = Model().add(
        box((-0.2, -0.2, 0), (0.2, 0.2, 0.95), upright=True, step=0.3),
        f.concrete((0.82, 0.81, 0.79), 12),
    )
    if seed % 2:
        t = np.linspace(0, 2 * np.pi, 73)
        knot = [
            (
                0.075 * (np.sin(a) + 1.6 * np.sin(2 * a)),
                0.075 * (np.cos(a) - 1.6 * np.cos(2 * a)),
                0.075 * -np.sin(3 * a) * 1.6 + 1.2,
            )
            for a in t
        ]
        return model.add(tube(knot, 0.045, 10), f.metal((0.72, 0.52, 0.3), 4, 0.25))
    t = np.linspace(0.0, 1.0, 26)
    radius = 0.05 + 0.1 * np.abs(np.sin(2.3 * np.pi * t + seed)) * (1.1 - t)
    profile = [
        (0.0, 0.95),
        *((float(r), 0.95 + 0.7 * float(z)) for r, z in zip(radius, t, strict=True)),
        (0.0, 1.66),
    ]
    return model.add(lathe(profile, 20), stone)
