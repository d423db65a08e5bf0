"""Things to sit, lie and eat on: sofas, armchairs, chairs, stools, beds, tables."""

import numpy as np

from r3jax.simulators.scenes.procedural.furniture import objects
from r3jax.simulators.scenes.procedural.materials import finishes as f
from r3jax.simulators.scenes.procedural.materials.textures import Real
from r3jax.simulators.scenes.procedural.model import Finish, Model
from r3jax.simulators.scenes.procedural.shapes import (
    box,
    combine,
    cushion,
    cylinder,
    drape,
    lathe,
    tube,
)


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
