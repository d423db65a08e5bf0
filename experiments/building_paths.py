"""What paths over a whole building cost a decision, all of it explored.

    python -m experiments.building_paths --side 200 --floors 4

Rooms of 6 m on floors of 3 m, doors in every wall, and a shaft every 36 m; a free-flying camera.
Milliseconds of CPU time, the least of several: bringing the coarse level up to date after a frame
that changed four tiles, and without a change; joining it to a graph; the search for all paths; and
the path to the far corner of the top floor, which only a robot that goes there waits for.
"""

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import tyro

from r3jax.mapping.tiles import Lattice, Tile
from r3jax.planning.far_paths import (
    FREE,
    OCCUPIED,
    Clearance,
    Coarse,
    cell_of,
    lengths_from,
    path_along,
    refreshed,
)

SIZE, ACROSS, FLOOR, ROOM = 0.2, 25, 3.0, 6.0
"""Edge of a cell [m], cells across a tile, height of a floor and edge of a room [m]."""

NO_TRAIL = np.zeros((0, 3), np.int64)


@dataclass(frozen=True)
class Options:
    """What to measure."""

    side: float = 200.0
    """Edge of the building [m]."""

    floors: int = 4
    """Floors."""

    tries: int = 5
    """Of which the least counts."""


def cells_of(tile: Tile, side: float, floors: int) -> np.ndarray:
    """Makes the cells of one tile, as tall as the building."""
    num = round(floors * FLOOR / SIZE)
    x, y = ((np.arange(ACROSS) + t * ACROSS + 0.5) * SIZE for t in tile[:2])
    x, y, z = x[:, None, None], y[None, :, None], (np.arange(num) + 0.5)[None, None, :] * SIZE
    above = z % FLOOR
    is_line = lambda a: np.minimum(a % ROOM, ROOM - a % ROOM) < 0.15
    is_door = lambda a: (np.abs(a % ROOM - ROOM / 2) < 0.6) & (above < 2.2)
    wall = (is_line(x) & ~is_door(y)) | (is_line(y) & ~is_door(x)) | (above < SIZE)
    shaft = (np.abs(x % 36.0 - 9.0) < 1.2) & (np.abs(y % 36.0 - 9.0) < 1.2)
    hull = [(a < SIZE) | (a > end - SIZE)
            for a, end in ((x, side), (y, side), (z, floors * FLOOR))]  # fmt: skip
    matter = (wall & ~shaft) | hull[0] | hull[1] | hull[2]
    return np.where(matter, OCCUPIED, FREE).astype(np.uint8)


def milliseconds(work: Callable[[], Any], tries: int) -> float:
    """Measures CPU time, the least of some tries after a first one."""
    work()
    spent = []
    for _ in range(tries):
        begin = time.process_time()
        work()
        spent.append(time.process_time() - begin)
    return round(1e3 * min(spent), 1)


def main(options: Options) -> dict[str, Any]:
    """Builds the coarse level of a building, and measures."""
    side, floors = options.side, options.floors
    num = int(np.ceil(side / (SIZE * ACROSS)))
    lattice = Lattice((0.0, 0.0, 0.0), (ACROSS, ACROSS, round(floors * FLOOR / SIZE)), SIZE,
                      (5, 5, 1), 6.5)  # fmt: skip
    box = np.array([[0.0, 0.0, 0.0], [side, side, floors * FLOOR]])
    every = {(i, j, 0): cells_of((i, j, 0), side, floors) for i in range(num) for j in range(num)}
    update = lambda coarse, now: refreshed(coarse, now, NO_TRAIL, Clearance(0.3), box)
    coarse = update(Coarse(lattice), every)
    middle = num // 2
    block = {t: x for t, x in every.items() if max(abs(t[0] - middle), abs(t[1] - middle)) <= 2}
    changed = dict(block)
    for i in (middle, middle + 1):
        for j in (middle, middle + 1):
            changed[i, j, 0] = block[i, j, 0].copy()
            changed[i, j, 0][5:20, 5:20, 3:6] = 0
    here, there = np.array([side / 2 + 3.0, side / 2 + 3.0, 1.3]), np.array([3.0, 3.0, 1.3])
    there[2] += (floors - 1) * FLOOR
    lengths = lengths_from(coarse, cell_of(lattice, here))
    assert lengths is not None
    path = path_along(coarse, lengths, here, there)
    (node,), (steps,) = coarse.nodes(cell_of(lattice, there)[None])
    arrays = [[x.cells, x.node, x.steps, x.centers, *x.edges] for x in coarse.tiles.values()]
    found = {
        "building": f"{side:g} x {side:g} x {floors * FLOOR:g} m",
        "nodes": len(coarse.graph.centers),
        "edges": coarse.graph.matrix.nnz,
        "bytes a tile": round(sum(a.nbytes for part in arrays for a in part) / len(arrays)),
        "update, nothing changed [ms]": milliseconds(lambda: update(coarse, block), options.tries),
        "update, four tiles [ms]": milliseconds(lambda: update(coarse, changed), options.tries),
        "graph [ms]": milliseconds(lambda: replace(coarse).graph, options.tries),
        "search [ms]": milliseconds(
            lambda: lengths_from(coarse, cell_of(lattice, here)), options.tries
        ),
        "one path [ms]": milliseconds(
            lambda: path_along(coarse, lengths, here, there), options.tries
        ),
        "its length [m]": round(float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()), 1),
        "its bound [m]": round(float(lengths.cost[node] + steps) * SIZE, 1),
        "straight line [m]": round(float(np.linalg.norm(there - here)), 1),
    }
    print(json.dumps(found, indent=1))
    return found


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
