"""Kitchens and bathrooms: units, appliances, sanitary ware. Backs on y = 0."""

import numpy as np

from r3jax.simulators.scenes.procedural.furniture import objects
from r3jax.simulators.scenes.procedural.materials import finishes as f
from r3jax.simulators.scenes.procedural.materials.textures import Real
from r3jax.simulators.scenes.procedural.model import Finish, Model
from r3jax.simulators.scenes.procedural.shapes import (
    ball,
    box,
    combine,
    curtain,
    cushion,
    cylinder,
    lathe,
    panel,
    quad,
    tube,
)


def _front(model: Model, x0: Real, x1: Real, z0: Real, z1: Real, y: Real, finish: Finish) -> None:
    """Builds a cupboard door or drawer front with a frame and a bar handle."""
    model.add(box((x0 + 0.003, y, z0 + 0.003), (x1 - 0.003, y + 0.018, z1 - 0.003)), finish)
    t = 0.06
    if z1 - z0 > 0.3:
        inner = box((x0 + t, y + 0.018, z0 + t), (x1 - t, y + 0.024, z1 - t))
        model.add(inner, finish, (0.94, 0.94, 0.94))
    x, z = (x0 + x1) / 2, z1 - 0.05
    bar = [
        (x - 0.07, y + 0.018, z),
        (x - 0.07, y + 0.05, z),
        (x + 0.07, y + 0.05, z),
        (x + 0.07, y + 0.018, z),
    ]
    model.add(tube([(float(a), float(b), float(c)) for a, b, c in bar], 0.006), f.metal())


def kitchen_run(
    width: Real, front: Finish, top: Finish, splash: Finish, seed: int, uppers: bool = True
) -> Model:
    """Builds a kitchen along a wall.

    It has units, a worktop, sink, hob and oven, a splashback and wall cupboards.
    """
    w, model = width / 2, Model()
    model.add(box((-w, 0, 0.1), (w, 0.56, 0.87)), front)
    model.add(box((-w + 0.02, 0.02, 0), (w - 0.02, 0.5, 0.1)), f.enamel(f.CHARCOAL, 1))
    model.add(box((-w - 0.01, 0, 0.87), (w + 0.01, 0.61, 0.91), step=0.5), top)
    model.add(quad((w, 0.006, 0.91), (-width, 0, 0), (0, 0, 0.55), 0.5), splash)
    units = max(2, round(width / 0.6))
    pitch = width / units
    for k in range(units):
        x0 = -w + k * pitch
        if k == 1:
            _oven(model, x0, x0 + pitch)
        elif k % 3 == 2:
            for j in range(3):
                _front(model, x0, x0 + pitch, 0.1 + 0.257 * j, 0.1 + 0.257 * (j + 1), 0.56, front)
        else:
            _front(model, x0, x0 + pitch, 0.1, 0.87, 0.56, front)
        if uppers and k != 1:
            model.add(box((x0, 0, 1.46), (x0 + pitch, 0.33, 2.15)), front)
            _front(model, x0, x0 + pitch, 1.46, 2.15, 0.33, front)
    _hood(model, -w + 1.5 * pitch)
    _sink(model, w - 0.5 * pitch if units < 4 else w - 1.5 * pitch)
    _worktop_things(model, width, pitch, seed)
    return model


def _oven(model: Model, x0: Real, x1: Real) -> None:
    steel, dark = f.metal(), f.enamel((0.1, 0.1, 0.11), 2, 0.8)
    model.add(box((x0 + 0.01, 0.56, 0.12), (x1 - 0.01, 0.585, 0.86)), steel)
    model.add(box((x0 + 0.05, 0.585, 0.25), (x1 - 0.05, 0.592, 0.62)), dark)
    model.add(tube([(x0 + 0.07, 0.63, 0.67), (x1 - 0.07, 0.63, 0.67)], 0.01), steel)
    for k in range(5):
        knob = cylinder(0.02, 0, 0.025, 10).turned(-90.0, "x")
        model.add(
            knob.moved(x0 + 0.1 + k * (x1 - x0 - 0.2) / 4, 0.585, 0.78), f.enamel(f.CHARCOAL, 1)
        )
    model.add(box((x0 + 0.03, 0.05, 0.911), (x1 - 0.03, 0.55, 0.918)), dark)
    middle = (x0 + x1) / 2
    for dx, dy, r in (
        (-0.13, 0.18, 0.08),
        (0.13, 0.18, 0.1),
        (-0.13, 0.42, 0.1),
        (0.13, 0.42, 0.07),
    ):
        model.add(
            cylinder(r, 0.918, 0.922, 18).moved(middle + dx, dy), f.metal((0.3, 0.3, 0.31), 1)
        )
    pot = lathe(
        [
            (0.0, 0.0),
            (0.1, 0.0),
            (0.1, 0.13),
            (0.105, 0.13),
            (0.1, 0.14),
            (0.03, 0.16),
            (0.0, 0.18),
        ],
        18,
    )
    model.add(pot.moved(middle - 0.13, 0.42, 0.922), f.enamel(f.TERRACOTTA, 3, 0.7))
    model.add(pot.moved(middle + 0.13, 0.18, 0.922), steel)


def _hood(model: Model, x: Real) -> None:
    steel = f.metal()
    model.add(box((x - 0.3, 0, 1.55), (x + 0.3, 0.48, 1.62)), steel)
    model.add(box((x - 0.13, 0, 1.62), (x + 0.13, 0.26, 2.35)), steel)


def _sink(model: Model, x: Real) -> None:
    steel = f.metal((0.74, 0.75, 0.76), 1, 0.25)
    model.add(box((x - 0.25, 0.1, 0.911), (x + 0.25, 0.52, 0.917)), steel)
    model.add(
        quad((x - 0.2, 0.14, 0.919), (0.4, 0, 0), (0, 0.34, 0)), f.metal((0.45, 0.46, 0.47), 2, 0.1)
    )
    tap = [(x, 0.07, 0.91), (x, 0.07, 1.16), (x, 0.11, 1.22), (x, 0.2, 1.21), (x, 0.22, 1.14)]
    model.add(tube(tap, 0.013, 8), steel)


def _worktop_things(model: Model, width: Real, pitch: Real, seed: int) -> None:
    w = width / 2
    board = box((-0.14, 0, 0), (0.14, 0.02, 0.38)).turned(12.0, "x")
    model.add(board.moved(-w + 0.2, 0.09, 0.91), f.wood(f.OAK, 4))
    model.put(objects.bottle(seed), -w + 0.42, 0.1, 0.91)
    model.put(objects.jar(seed), -w + 0.1, 0.34, 0.91)
    free = np.arange(-w + 2 * pitch + 0.12, w - 0.1, 0.22)
    for k, x in enumerate(free):
        thing = (
            objects.jar(seed + k),
            objects.carton(seed + k),
            objects.crockery(k),
            objects.bottle(seed + k),
            objects.jar(seed + 3 + k, 0.055, 0.22),
        )
        model.put(thing[k % 5], float(x), 0.15 + 0.05 * (k % 3), 0.92, 14.0 * k)


def fridge(seed: int) -> Model:
    """Builds a tall refrigerator with notes on its door."""
    steel = f.metal((0.78, 0.79, 0.8), 2, 0.12)
    model = Model().add(box((-0.3, 0, 0.03), (0.3, 0.6, 1.85)), steel)
    for z0, z1 in ((0.06, 0.66), (0.68, 1.84)):
        model.add(box((-0.295, 0.6, z0), (0.295, 0.64, z1)), steel)
        z = z1 - 0.12 if z0 < 0.5 else z0 + 0.2
        model.add(
            tube(
                [
                    (0.24, 0.64, z - 0.12),
                    (0.24, 0.68, z - 0.1),
                    (0.24, 0.68, z + 0.1),
                    (0.24, 0.64, z + 0.12),
                ],
                0.009,
            ),
            f.metal(),
        )
    for k, (x, z) in enumerate(((-0.13, 1.5), (0.03, 1.62), (-0.05, 1.25), (-0.18, 1.12))):
        note = panel(x, z, 0.13, 0.17, 0.643)
        model.add(note, f.picture(("poster", "landscape", "abstract", "sunset")[k], 70 + k))
    return model.put(objects.carton(seed, 0.25, 0.2, 0.22), -0.1, 0.3, 1.85)


def island(width: Real, front: Finish, top: Finish, seed: int) -> Model:
    """Builds a kitchen island, origin in its middle, with fruit, bottles and a plant."""
    w, model = width / 2, Model()
    model.add(box((-w, -0.35, 0), (w, 0.35, 0.87), upright=True, step=0.5), front)
    model.add(box((-w - 0.05, -0.42, 0.87), (w + 0.05, 0.42, 0.92), step=0.5), top)
    units = max(2, round(width / 0.5))
    for k in range(units):
        _front(model, -w + k * width / units, -w + (k + 1) * width / units, 0.08, 0.86, 0.35, front)
    model.put(objects.bowl_of_fruit(seed), -0.2 * width, 0.05, 0.92)
    model.put(objects.bottle(seed), 0.15 * width, -0.1, 0.92)
    model.put(objects.bottle(seed + 1), 0.22 * width, 0.02, 0.92)
    return model.put(objects.leafy_plant(0.42, seed, 24), 0.38 * width, 0.0, 0.92)


def kitchen_shelf(seed: int, width: Real = 1.2) -> list[Model]:
    """Builds packages, jars and bottles for a wall shelf."""
    makers = (objects.jar, objects.carton, objects.bottle)
    return [makers[k % 3](seed + k) for k in range(round(width / 0.13))]


def toilet() -> Model:
    """Builds a floor-standing toilet with a cistern and a lid, and paper beside it."""
    white = f.enamel((0.93, 0.93, 0.92), 6, 0.8)
    model = Model().add(cushion((-0.2, 0.0, 0.4), (0.2, 0.2, 0.82), 0.2), white)
    bowl = lathe([(0.0, 0.0), (0.12, 0.0), (0.1, 0.15), (0.19, 0.36), (0.2, 0.41), (0.0, 0.42)], 20)
    model.add(bowl.moved(0, 0.42), white)
    model.add(ball((0.2, 0.25, 0.022), 20, 5).moved(0, 0.42, 0.43), white)
    model.add(box((-0.12, 0.12, 0.0), (0.12, 0.42, 0.36)), white)
    roll = cylinder(0.055, -0.05, 0.05, 14).turned(90.0, "y")
    return model.add(roll.moved(0.38, 0.08, 0.72), f.fabric(f.WHITE, 4))


def washbasin(width: Real, front: Finish, seed: int) -> Model:
    """Builds a basin on a cabinet under a mirror with a lamp; bottles and a towel."""
    w, white = width / 2, f.enamel((0.93, 0.93, 0.92), 6, 0.8)
    model = Model().add(box((-w, 0, 0.3), (w, 0.44, 0.78)), front)
    for x0, x1 in ((-w, 0.0), (0.0, w)):
        _front(model, x0, x1, 0.3, 0.78, 0.44, front)
    model.add(
        box((-w - 0.02, 0, 0.78), (w + 0.02, 0.48, 0.82)),
        f.marble((0.9, 0.89, 0.87), (0.5, 0.5, 0.52), 22),
    )
    basin = lathe([(0.1, 0.82), (0.19, 0.94), (0.175, 0.94), (0.08, 0.84), (0.0, 0.835)], 22)
    model.add(basin.moved(0, 0.25), white)
    model.add(
        tube([(0, 0.04, 0.82), (0, 0.04, 1.02), (0, 0.14, 1.04), (0, 0.16, 1.0)], 0.012, 8),
        f.metal(),
    )
    model.add(box((-w - 0.02, 0, 1.16), (w + 0.02, 0.024, 1.96)), f.wood(f.OAK, 2))
    model.add(panel(0, 1.18, width, 0.76, 0.028), f.mirror())
    model.add(box((-0.25, 0.03, 2.0), (0.25, 0.09, 2.06)), f.glow((1.0, 0.97, 0.88), 5, 1.0))
    model.light((0.0, 0.15, 2.0), 1.3, (0.6, 0.57, 0.5))
    for k in range(3):
        model.put(objects.bottle(seed + k, 0.17 + 0.03 * k), w - 0.06 - 0.09 * k, 0.1, 0.82)
    return model.put(objects.jar(seed), -w + 0.1, 0.12, 0.82)


def bathtub(length: Real = 1.7) -> Model:
    """Builds a tub along the wall with a printed shower curtain half drawn."""
    white, w = f.enamel((0.93, 0.93, 0.92), 6, 0.8), length / 2
    model = Model().add(
        box((-w, 0.7, 0), (w, 0.75, 0.56), upright=True),
        f.tiled(((0.85, 0.88, 0.88), (0.5, 0.62, 0.64)), 31, 12, 12, 0.1),
    )
    rim = (
        (-w, 0.0, w, 0.07),
        (-w, 0.68, w, 0.76),
        (-w, 0.07, -w + 0.08, 0.68),
        (w - 0.08, 0.07, w, 0.68),
    )
    for x0, y0, x1, y1 in rim:
        model.add(box((x0, y0, 0.54), (x1, y1, 0.58)), white)
    model.add(quad((-w + 0.08, 0.07, 0.2), (length - 0.16, 0, 0), (0, 0.61, 0), 0.3), white)
    inside = [
        panel(0, 0.2, length - 0.16, 0.36, 0.07),
        quad((-w + 0.08, 0.68, 0.2), (length - 0.16, 0, 0), (0, 0, 0.36)),
        quad((-w + 0.08, 0.07, 0.2), (0, 0.61, 0), (0, 0, 0.36)),
        quad((w - 0.08, 0.68, 0.2), (0, -0.61, 0), (0, 0, 0.36)),
    ]
    model.add(combine(inside), white)
    model.add(tube([(-w, 0.74, 2.02), (w, 0.74, 2.02)], 0.012, 8), f.metal())
    cloth = f.printed((0.9, 0.93, 0.92), (f.TEAL, f.SAGE, f.MUSTARD), "botanical", 33)
    model.add(curtain(0.55, 0.25, 2.0, 6, 0.04).moved(-w + 0.35, 0.74), cloth)
    model.add(
        tube([(w - 0.3, 0.02, 0.75), (w - 0.3, 0.16, 0.75), (w - 0.3, 0.2, 0.7)], 0.018, 8),
        f.metal(),
    )
    return model.add(
        tube([(w - 0.3, 0.03, 0.8), (w - 0.3, 0.03, 2.05), (w - 0.3, 0.3, 2.08)], 0.011), f.metal()
    )


def towel_rail(seed: int) -> Model:
    """Builds a ladder rail with two folded towels."""
    steel, model = f.metal(), Model()
    for x in (-0.25, 0.25):
        model.add(tube([(x, 0.07, 0.6), (x, 0.07, 1.75)], 0.015, 8), steel)
    for z in np.arange(0.7, 1.75, 0.14):
        model.add(tube([(-0.25, 0.07, float(z)), (0.25, 0.07, float(z))], 0.01), steel)
    towels = (
        f.striped((f.WHITE, f.TEAL, f.WHITE), seed, 3),
        f.plaid(f.BLUSH, f.WHITE, f.TERRACOTTA, seed),
    )
    for towel, z0, z1 in zip(towels, (0.72, 1.22), (1.14, 1.6), strict=True):
        model.add(curtain(0.4, z0, z1, 2, 0.012).moved(0, 0.105), towel)
    return model


def washing_machine() -> Model:
    """Builds a front loader with a box of powder on top."""
    white = f.enamel(f.WHITE, 7, 0.5)
    model = Model().add(box((-0.3, 0, 0), (0.3, 0.58, 0.85)), white)
    ring = cylinder(0.19, 0, 0.03, 24, 0.17).turned(-90.0, "x")
    model.add(ring.moved(0, 0.58, 0.45), f.metal())
    door = ball((0.14, 0.03, 0.14), 18, 8).moved(0, 0.61, 0.45)
    model.add(door, f.enamel((0.15, 0.17, 0.2), 2, 0.9))
    model.add(panel(-0.05, 0.74, 0.42, 0.08, 0.583), f.keyboard())
    return model.put(objects.carton(5, 0.18, 0.12, 0.26), 0.1, 0.25, 0.85, 20.0)
