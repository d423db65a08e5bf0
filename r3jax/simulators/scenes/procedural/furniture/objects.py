"""Small things: on furniture (books, plants, lamps), on walls, windows and floors (pictures, rugs).

The origin of what stands is the middle of its foot, unless a function says otherwise. Pieces for
walls have their back on y = 0, and z is measured from the floor.
"""

import numpy as np

from r3jax.simulators.scenes.procedural.materials import finishes as f
from r3jax.simulators.scenes.procedural.materials.artwork import SPINES
from r3jax.simulators.scenes.procedural.materials.textures import Color, Real
from r3jax.simulators.scenes.procedural.model import Finish, Model
from r3jax.simulators.scenes.procedural.shapes import (
    Shape,
    ball,
    box,
    combine,
    curtain,
    cylinder,
    disc,
    grid,
    lathe,
    panel,
    quad,
    tube,
)

_BRIGHT = (f.TERRACOTTA, f.MUSTARD, f.TEAL, f.NAVY, f.BLUSH, f.SAGE, f.CREAM, f.CHARCOAL)


def _on_spine(shape: Shape, spine: int, low: Real = 0.02, high: Real = 0.98) -> Shape:
    """Fits a shape's coordinates into one spine of the book atlas."""
    span = np.maximum(shape.uv.max(axis=(0, 1)) - shape.uv.min(axis=(0, 1)), 1e-9)
    unit = (shape.uv - shape.uv.min(axis=(0, 1))) / span
    u = (spine + 0.06 + 0.88 * unit[..., 0]) / SPINES
    return Shape(shape.corners, np.stack([u, low + (high - low) * unit[..., 1]], axis=-1))


def book_row(length: Real, height: Real, depth: Real, seed: int, thickness: Real = 1.0) -> Model:
    """Builds books side by side with a few gaps and leaners, spines towards +y.

    Spans x = 0 .. length, y = 0 .. depth; no book is taller than `height`. Books are 1.8 to 5.6 cm
    thick, times `thickness`.
    """
    rng = np.random.default_rng(seed)
    covers: list[Shape] = []
    pages: list[Shape] = []
    x = 0.0
    while x < length - 0.02:
        thick = min(thickness * (0.018 + 0.038 * rng.random()), length - x)
        tall = height * (0.68 + 0.3 * rng.random())
        deep = depth * (0.7 + 0.28 * rng.random())
        spine = int(rng.integers(SPINES))
        if rng.random() < 0.06:
            x += 0.04 + 0.1 * rng.random()
            continue
        front = panel(x + thick / 2, 0.0, thick - 0.002, tall, deep)
        left = quad((x + 0.001, deep, 0.0), (0, -deep, 0), (0, 0, tall))
        right = quad((x + thick - 0.001, 0.0, 0.0), (0, deep, 0), (0, 0, tall))
        covers += [_on_spine(front, spine), _on_spine(left + right, spine, 0.12, 0.2)]
        pages.append(
            quad((x + 0.003, 0.004, tall - 0.002), (thick - 0.006, 0, 0), (0, deep - 0.01, 0))
        )
        x += thick
    model = Model()
    if covers:
        model.add(combine(covers), f.spines(seed % 3), atlas=True)
        model.add(combine(pages), f.striped((f.CREAM, (0.8, 0.74, 0.62)), 3, 12))
    return model


def book_pile(count: int, seed: int) -> Model:
    """Builds a pile of lying books, spines about +y."""
    rng = np.random.default_rng(seed)
    model, z = Model(), 0.0
    for _ in range(count):
        w, d, t = 0.2 + 0.08 * rng.random(), 0.14 + 0.05 * rng.random(), 0.02 + 0.025 * rng.random()
        spine = int(rng.integers(SPINES))
        cover = _on_spine(box((-w / 2, -d / 2, 0), (w / 2, d / 2, t)), spine, 0.1, 0.5)
        back = panel(0, 0, w, t, d / 2 + 0.001)
        back = Shape(back.corners, back.uv[..., ::-1])
        book = Model().add(cover, f.spines(seed % 3), atlas=True)
        book.add(_on_spine(back, spine), f.spines(seed % 3), atlas=True)
        model.put(book, 0.01 * rng.normal(), 0.01 * rng.normal(), z, 12.0 * rng.normal())
        z += t
    return model


def vase(seed: int, height: Real = 0.28) -> Model:
    """Builds a turned vase; every second one is glazed in two colors."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 1.0, 9)
    belly = 0.3 + 0.22 * np.sin(np.pi * (t * (0.8 + 0.5 * rng.random())) + 0.6 * rng.random())
    profile = [
        (0.0, 0.0),
        *((float(b) * 0.6 * height, float(a) * height) for a, b in zip(t, belly, strict=True)),
    ]
    color = _BRIGHT[seed % len(_BRIGHT)]
    finish = (
        f.striped((color, f.CREAM, color), seed % 5) if seed % 2 else f.enamel(color, seed % 5, 0.6)
    )
    return Model().add(lathe(profile, 16), finish)


def bowl_of_fruit(seed: int) -> Model:
    """Builds a wooden bowl of oranges, apples and lemons."""
    rng = np.random.default_rng(seed)
    bowl = lathe(
        [(0.0, 0.0), (0.06, 0.0), (0.14, 0.06), (0.16, 0.09), (0.15, 0.09), (0.1, 0.04), (0, 0.03)],
        18,
    )
    model = Model().add(bowl, f.wood(f.WALNUT, 2))
    peel = f.leather((0.95, 0.92, 0.85), 9)
    for k in range(9):
        angle, reach = 2.4 * k, 0.03 + 0.008 * k
        tint = ((0.95, 0.55, 0.12), (0.75, 0.16, 0.12), (0.93, 0.83, 0.25), (0.5, 0.66, 0.2))[k % 4]
        r = 0.033 + 0.008 * rng.random()
        fruit = ball((r, r, r * 0.93), 8, 5)
        model.add(
            fruit.moved(reach * np.cos(angle), reach * np.sin(angle), 0.085 + 0.03 * (k < 4)),
            peel,
            tint,
        )
    return model


def leafy_plant(height: Real, seed: int, leaves: int = 34, broad: Real = 0.3) -> Model:
    """Builds a pot plant with arching leaves; `broad` is the width of a leaf over its length."""
    rng = np.random.default_rng(seed)
    pot = 0.13 * height + 0.04
    outside = [(0.0, 0.0), (0.75, 0.0), (1.0, 1.5), (1.06, 1.6), (0.9, 1.6)]
    rim = [(r * pot, z * pot) for r, z in outside]
    color = _BRIGHT[seed % len(_BRIGHT)]
    model = Model().add(lathe(rim, 16), f.enamel(color, seed % 4, 0.3))
    model.add(
        lathe([(0.92 * pot, 1.45 * pot), (0.0, 1.46 * pot)], 12),
        f.carpet((0.25, 0.18, 0.13), (0.4, 0.32, 0.25), 2),
    )
    blades: dict[int, list[Shape]] = {0: [], 1: []}
    for k in range(leaves):
        angle = 2.39996 * k + 0.3 * rng.random()
        lift = 1.35 - 1.1 * (k / leaves) * (0.8 + 0.4 * rng.random())
        length = (height - 1.5 * pot) * (0.62 + 0.35 * rng.random())
        root = 1.45 * pot + (0.35 * (height - 1.5 * pot) * (1 - k / leaves) if broad > 0.2 else 0.0)
        blades[k % 2].append(_blade(length, broad, lift).turned(np.rad2deg(angle)).moved(z=root))
    # Leaves keep within the pot's surroundings, clear of walls and shelf boards.
    widest = max(float(np.abs(s.corners[..., :2]).max()) for k in blades for s in blades[k])
    shrink = min(1.0, min(0.42, 0.36 * height) / widest)
    spread = np.array([shrink, shrink, 1.0])
    for k, shapes in blades.items():
        green = ((0.22, 0.42, 0.16), (0.33, 0.5, 0.2), (0.16, 0.36, 0.22))[(seed + k) % 3]
        joined = combine(shapes)
        model.add(Shape(joined.corners * spread, joined.uv), f.leaf(green, k), atlas=True)
    if broad > 0.2:
        model.add(
            tube([(0, 0, pot), (0.02, 0.01, 0.5 * height), (0, 0.02, 0.75 * height)], 0.012),
            f.wood(f.EBONY, 1),
        )
    return model


def _blade(length: Real, broad: Real, lift: Real) -> Shape:
    """Makes a leaf that starts at the origin along +x, rises and bends down; unit coordinates."""
    t = np.linspace(0.0, 1.0, 6)
    angle = lift - 1.5 * t**1.5
    step = length / 5
    x = np.concatenate([[0.0], np.cumsum(np.cos(angle[:-1]) * step)])
    z = np.concatenate([[0.0], np.cumsum(np.sin(angle[:-1]) * step)])
    half = 0.5 * broad * length * np.sin(np.pi * np.clip(0.06 + 0.94 * t, 0, 1) ** 0.75) + 0.003
    side = np.array([-1.0, 0.0, 1.0])
    cup = 0.25 * half[None, :] * np.abs(side)[:, None]
    points = np.stack(
        [np.broadcast_to(x, (3, 6)), side[:, None] * half[None, :], z[None, :] + cup], axis=-1
    )
    return grid(points, t, (side + 1.0) / 2.0)


def table_lamp(seed: int, height: Real = 0.45) -> Model:
    """Builds a lamp with a cloth shade that glows and lights its surroundings."""
    color = _BRIGHT[seed % len(_BRIGHT)]
    foot = lathe(
        [(0.0, 0.0), (0.08, 0.0), (0.08, 0.02), (0.025, 0.05), (0.05, 0.14), (0.02, 0.55 * height)],
        14,
    )
    model = Model().add(foot, f.enamel(color, 1, 0.6))
    shade = lathe([(0.13, 0.5 * height), (0.09, height)], 18)
    model.add(shade, f.glow((0.98, 0.9, 0.72), 1))
    return model.light((0.0, 0.0, 0.8 * height), 1.0, (0.5, 0.42, 0.3))


def floor_lamp(seed: int) -> Model:
    """Builds a standing lamp, 1.6 m, with a drum shade."""
    model = Model().add(cylinder(0.15, 0.0, 0.025, 18), f.metal((0.35, 0.34, 0.33), 1))
    model.add(cylinder(0.014, 0.025, 1.35, 8), f.metal((0.35, 0.34, 0.33), 1))
    tint = ((0.98, 0.9, 0.74), (0.97, 0.84, 0.66))[seed % 2]
    model.add(lathe([(0.2, 1.28), (0.17, 1.6)], 20), f.glow(tint, 2))
    return model.light((0.0, 0.0, 1.45), 1.4, (0.6, 0.5, 0.36))


def pendant(
    ceiling: Real, drop: Real = 0.55, radius: Real = 0.22, seed: int = 0, reach: Real = 2.4
) -> Model:
    """Builds a hanging lamp: cord, dome, glowing bulb. Origin on the floor below it."""
    top = ceiling - drop
    model = Model().add(
        tube([(0, 0, ceiling), (0, 0, top + 0.2)], 0.006, 5), f.enamel(f.CHARCOAL, 1)
    )
    dome = [
        (radius, top),
        (0.92 * radius, top + 0.08),
        (0.55 * radius, top + 0.17),
        (0.1 * radius, top + 0.21),
    ]
    model.add(lathe(dome, 20), f.enamel(_BRIGHT[seed % len(_BRIGHT)], 2, 0.5))
    model.add(
        ball((0.06, 0.06, 0.06), 10, 6).moved(z=top + 0.05), f.glow((1.0, 0.96, 0.84), 3, 1.0)
    )
    return model.light((0.0, 0.0, top - 0.02), reach, (0.85, 0.75, 0.6))


def ceiling_panel(ceiling: Real, width: Real = 1.2, depth: Real = 0.3, reach: Real = 2.6) -> Model:
    """Builds a fluorescent panel under the ceiling. Origin on the floor below its middle."""
    w, d = width / 2, depth / 2
    model = Model().add(
        box((-w, -d, ceiling - 0.06), (w, d, ceiling)), f.metal((0.8, 0.8, 0.8), 2, 0.05)
    )
    lens = quad((-w + 0.02, d - 0.02, ceiling - 0.061), (width - 0.04, 0, 0), (0, -depth + 0.04, 0))
    model.add(lens, f.glow((0.99, 0.99, 0.95), 4, 1.0))
    return model.light((0.0, 0.0, ceiling - 0.25), reach, (0.72, 0.72, 0.7))


def carton(seed: int, width: Real = 0.12, depth: Real = 0.08, height: Real = 0.2) -> Model:
    """Builds a printed carton."""
    return Model().add(_six_prints(width, depth, height), f.package(seed % 12), atlas=True)


def _six_prints(w: Real, d: Real, h: Real) -> Shape:
    """Makes a box whose every face shows the whole print; unit coordinates."""
    shape = box((-w / 2, -d / 2, 0), (w / 2, d / 2, h), upright=True)
    uv = shape.uv.reshape(6, -1, 3, 2)
    return Shape(shape.corners, (uv / uv.max(axis=(1, 2), keepdims=True)).reshape(-1, 3, 2))


def jar(seed: int, radius: Real = 0.045, height: Real = 0.16) -> Model:
    """Builds a tin or jar with a printed label and a lid."""
    body = lathe([(radius, 0.0), (radius, height)], 14)
    model = Model().add(body, f.package((seed + 5) % 12))
    lid = [(1.04 * radius, height), (1.04 * radius, 1.12 * height), (0.0, 1.13 * height)]
    return model.add(lathe(lid, 14), f.metal((0.75, 0.68, 0.5), 3))


def bottle(seed: int, height: Real = 0.3) -> Model:
    """Builds a glazed bottle with a label."""
    r = 0.13 * height
    profile = [
        (0, 0),
        (r, 0),
        (r, 0.6 * height),
        (0.35 * r, 0.78 * height),
        (0.35 * r, height),
        (0, height),
    ]
    green = ((0.16, 0.32, 0.2), (0.35, 0.2, 0.1), (0.2, 0.3, 0.42))[seed % 3]
    model = Model().add(
        lathe([(float(a), float(b)) for a, b in profile], 12), f.enamel(green, 3, 0.8)
    )
    label = lathe([(1.02 * r, 0.15 * height), (1.02 * r, 0.48 * height)], 12)
    return model.add(label, f.package((seed + 2) % 12))


def crockery(seed: int) -> Model:
    """Builds a place setting: plate, bowl, mug."""
    white, color = f.enamel(f.WHITE, 5, 0.7), f.enamel(_BRIGHT[seed % len(_BRIGHT)], 2, 0.6)
    plate = lathe([(0.0, 0.004), (0.08, 0.004), (0.13, 0.02), (0.13, 0.014), (0.08, 0.0)], 16)
    bowl = lathe([(0.04, 0.012), (0.075, 0.06), (0.07, 0.06), (0.03, 0.02), (0.0, 0.02)], 12)
    mug = lathe(
        [(0.0, 0.0), (0.038, 0.0), (0.038, 0.09), (0.034, 0.09), (0.034, 0.02), (0.0, 0.02)], 14
    )
    handle = tube([(0.038, 0, 0.02), (0.065, 0, 0.03), (0.065, 0, 0.06), (0.038, 0, 0.075)], 0.006)
    model = Model().add(plate, white).add(bowl, color)
    return model.put(Model().add(mug + handle, color), 0.2, 0.06, 0.0, 30.0 * seed)


def clutter(seed: int) -> Model:
    """Builds one small thing, chosen by the seed: for shelves."""
    makers = (
        lambda: vase(seed, 0.16 + 0.02 * (seed % 5)),
        lambda: book_pile(3 + seed % 3, seed),
        lambda: jar(seed),
        lambda: carton(seed),
        lambda: leafy_plant(0.26, seed, 12),
        lambda: bottle(seed, 0.24),
        lambda: Model().add(
            ball((0.07, 0.07, 0.07), 14, 9).moved(z=0.07),
            f.wallpaper(f.CREAM, (f.TERRACOTTA, f.TEAL), "trellis", 4),
        ),
        lambda: standing_frame(seed),
    )
    return makers[seed % len(makers)]()


def standing_frame(seed: int) -> Model:
    """Builds a small framed photograph that leans back a little."""
    model = Model().add(box((-0.08, -0.01, 0), (0.08, 0.005, 0.2)), f.wood(f.EBONY, 1))
    model.add(
        panel(0, 0.012, 0.136, 0.176, 0.006),
        f.picture("sunset" if seed % 2 else "landscape", 30 + seed % 4),
    )
    return model


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
