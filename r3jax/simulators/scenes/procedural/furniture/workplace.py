"""Offices and classrooms: glass partitions, workstations, meeting tables, school desks."""

import numpy as np

from r3jax.simulators.scenes.procedural.furniture import objects, seating, storage
from r3jax.simulators.scenes.procedural.materials import finishes as f
from r3jax.simulators.scenes.procedural.materials.textures import Real
from r3jax.simulators.scenes.procedural.model import Finish, Model
from r3jax.simulators.scenes.procedural.shapes import (
    ball,
    box,
    combine,
    cylinder,
    panel,
    quad,
    tube,
)


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
    model = storage.desk(
        width, f.wood(f.BEECH if seed % 2 else f.OAK, seed % 3), seed, 1 + seed % 2
    )
    cloth = f.fabric((f.CHARCOAL, f.TEAL, f.NAVY, f.TERRACOTTA)[seed % 4], seed % 3)
    chair = seating.office_chair(cloth)
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
    model = Model().put(seating.table(width, depth, f.wood(f.WALNUT, 4, 0.35), 0.74))
    for k in range(seats):
        x = (k + 0.5) * width / seats - width / 2
        for side, heading in ((-1, 0.0), (1, 180.0)):
            chair = seating.office_chair(f.leather((0.2, 0.19, 0.19), 2))
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
    model = Model().put(storage.drawers(0.8, 1.15, 0.45, f.enamel(color, 4, 0.3), 1, 4))
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
    model = Model().put(seating.table(1.2, 0.5, f.wood(f.BEECH, seed % 3), 0.72))
    tint = (f.TEAL, f.TERRACOTTA, f.MUSTARD, f.NAVY)[seed % 4]
    for k, x in enumerate((-0.3, 0.3)):
        chair = seating.chair(f.metal((0.4, 0.41, 0.43), 3, 0.05), f.enamel(tint, 2, 0.3))
        model.put(chair, x, 0.42, 0, 180.0 + 8.0 * ((seed + k) % 3 - 1))
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
    """Builds a rail along x under the ceiling with spotlights that shine on what is below."""
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
    model = Model().put(storage.drawers(0.45, 0.7, 0.55, wood, 1, 3), -0.5, -0.3)
    model.put(seating.table(1.5, 0.7, wood, 0.76))
    model.put(globe(1), 0.55, 0.1, 0.76)
    model.put(objects.book_pile(5, 4), -0.5, 0.1, 0.76, 25.0)
    model.put(objects.book_pile(3, 9), 0.1, -0.1, 0.76)
    return model.put(seating.chair(wood, f.leather((0.4, 0.22, 0.15), 1)), 0.0, -0.6, 0, 12.0)
