"""Things on walls, windows and floors: pictures, mirrors, curtains, radiators, rugs.

Wall pieces have their back on y = 0 and z measured from the floor.
"""

import numpy as np

from r3jax.simulators.scenes.procedural.materials import finishes as f
from r3jax.simulators.scenes.procedural.materials.textures import Color, Real
from r3jax.simulators.scenes.procedural.model import Finish, Model
from r3jax.simulators.scenes.procedural.shapes import (
    box,
    combine,
    curtain,
    cylinder,
    disc,
    panel,
    quad,
    tube,
)


def picture(
    kind: str, seed: int, width: Real, height: Real, z: Real = 1.55, frame: Finish | None = None
) -> Model:
    """Builds a framed picture, its middle at height z."""
    finish = frame or f.wood(f.EBONY, 1)
    w, h, t = width / 2, height / 2, 0.035
    bars = [
        box((-w - t, 0, z - h - t), (w + t, 0.03, z - h)),
        box((-w - t, 0, z + h), (w + t, 0.03, z + h + t)),
        box((-w - t, 0, z - h), (-w, 0.03, z + h)),
        box((w, 0, z - h), (w + t, 0.03, z + h)),
    ]
    model = Model().add(combine(bars), finish)
    return model.add(panel(0, z - h, width, height, 0.015), f.picture(kind, seed, width > height))


def wall_mirror(width: Real, height: Real, z: Real, frame: Finish | None = None) -> Model:
    """Builds a framed mirror, its middle at height z."""
    finish = frame or f.wood(f.WALNUT, 2)
    w, h = width / 2, height / 2
    model = Model().add(box((-w - 0.04, 0, z - h - 0.04), (w + 0.04, 0.025, z + h + 0.04)), finish)
    return model.add(panel(0, z - h, width, height, 0.028), f.mirror())


def curtains(width: Real, top: Real, finish: Finish, bottom: Real = 0.04) -> Model:
    """Builds a pair of open curtains on a rail for a window of the given width."""
    model = Model()
    rail = tube([(-width / 2 - 0.45, 0.1, top), (width / 2 + 0.45, 0.1, top)], 0.015, 8)
    model.add(rail, f.metal((0.3, 0.28, 0.26), 1))
    for side in (-1, 1):
        cloth = curtain(0.5, bottom, top - 0.02, 5).moved(side * (width / 2 + 0.16), 0.1)
        model.add(cloth, finish)
    return model


def radiator(width: Real = 1.0, height: Real = 0.55) -> Model:
    """Builds a column radiator with its valve and pipe."""
    white, count = f.enamel(f.WHITE, 4, 0.3), max(3, round(width / 0.07))
    columns = [
        box((x - 0.026, 0.04, 0.12), (x + 0.026, 0.13, 0.12 + height))
        for x in np.linspace(-width / 2, width / 2, count)
    ]
    model = Model().add(combine(columns), white)
    model.add(box((-width / 2, 0.06, 0.16), (width / 2, 0.11, 0.2)), white)
    pipe = tube(
        [(width / 2 + 0.07, 0.08, 0.0), (width / 2 + 0.07, 0.08, 0.18), (width / 2, 0.08, 0.18)],
        0.011,
    )
    return model.add(pipe, f.metal((0.72, 0.5, 0.36), 2))


def rug(width: Real, depth: Real, palette: tuple[Color, ...], seed: int) -> Model:
    """Builds a rug, origin in its middle."""
    sheet = quad((-width / 2, -depth / 2, 0.012), (width, 0, 0), (0, depth, 0), 0.3)
    rim = box((-width / 2, -depth / 2, 0.001), (width / 2, depth / 2, 0.0115))
    return Model().add(sheet, f.rug(palette, seed)).add(rim, f.fabric(palette[0], 1))


def clock(seed: int, z: Real = 2.0, radius: Real = 0.17) -> Model:
    """Builds a round wall clock, its middle at height z."""
    case = cylinder(radius, 0.0, 0.035, 24).turned(-90.0, "x").moved(z=z)
    model = Model().add(case, f.enamel(f.CHARCOAL, 1))
    return model.add(disc(0.92 * radius, 0.037).moved(z=z), f.clock_face(seed))


def board(kind: str, width: Real, height: Real, z: Real, seed: int) -> Model:
    """Builds a framed "white" or "black" board with a tray, its middle at height z."""
    w, h = width / 2, height / 2
    frame = f.metal((0.75, 0.75, 0.76), 1) if kind == "white" else f.wood(f.OAK, 1)
    model = Model().add(box((-w - 0.03, 0, z - h - 0.03), (w + 0.03, 0.02, z + h + 0.03)), frame)
    model.add(panel(0, z - h, width, height, 0.022), f.board(kind, seed))
    return model.add(box((-0.6 * w, 0.02, z - h - 0.03), (0.6 * w, 0.1, z - h - 0.01)), frame)


def picture_group(seed: int, z: Real = 1.6) -> Model:
    """Builds five small pictures hung as a cloud, about 1.7 m wide."""
    model = Model()
    kinds = ("poster", "landscape", "abstract", "sunset", "abstract")
    spots = (
        (-0.6, 0.05, 0.36, 0.48),
        (-0.1, 0.26, 0.5, 0.36),
        (-0.12, -0.2, 0.3, 0.38),
        (0.55, 0.24, 0.46, 0.34),
        (0.45, -0.2, 0.34, 0.42),
    )
    for k, (x, dz, w, h) in enumerate(spots):
        frame = (f.wood(f.EBONY, 1), f.wood(f.OAK, 1), f.enamel(f.WHITE, 3, 0.2))[k % 3]
        model.put(picture(kinds[k], seed + k, w, h, z + dz, frame), x)
    return model


def wall_shelf(width: Real, z: Real, things: list[Model]) -> Model:
    """Builds a board on brackets with things spread over it."""
    model = Model().add(box((-width / 2, 0, z - 0.03), (width / 2, 0.24, z)), f.wood(f.OAK, 2))
    for x in (-width / 2 + 0.15, width / 2 - 0.15):
        model.add(
            box((x - 0.012, 0, z - 0.2), (x + 0.012, 0.2, z - 0.03)), f.metal((0.25, 0.25, 0.26), 1)
        )
    for k, thing in enumerate(things):
        model.put(thing, -width / 2 + (k + 0.5) * width / len(things), 0.12, z)
    return model


def coat_rack(seed: int) -> Model:
    """Builds hooks on a board with two coats and a scarf."""
    model = Model().add(box((-0.5, 0, 1.62), (0.5, 0.025, 1.74)), f.wood(f.WALNUT, 3))
    cloths = (
        f.fabric(f.NAVY, 2),
        f.plaid((0.5, 0.4, 0.3), (0.2, 0.15, 0.12), (0.85, 0.75, 0.5), 4),
        f.fabric(f.MUSTARD, 3),
    )
    for k, x in enumerate((-0.35, -0.05, 0.28)):
        model.add(tube([(x, 0.02, 1.68), (x, 0.08, 1.66), (x, 0.1, 1.7)], 0.008), f.metal())
        length = (0.95, 0.75, 0.6)[(k + seed) % 3]
        cloth = curtain((0.34, 0.3, 0.14)[k], 1.66 - length, 1.68, 3, 0.035).moved(x, 0.08)
        model.add(cloth, cloths[k])
    return model
