"""Things to keep things in: bookshelves, wardrobes, sideboards, television units, desks."""

import numpy as np

from r3jax.simulators.scenes.procedural.furniture import objects
from r3jax.simulators.scenes.procedural.materials import finishes as f
from r3jax.simulators.scenes.procedural.materials.textures import Real
from r3jax.simulators.scenes.procedural.model import Finish, Model
from r3jax.simulators.scenes.procedural.shapes import box, combine, cylinder, panel, quad, tube


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
