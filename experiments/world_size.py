"""What a frame and a decision cost in worlds of any size, with the same surroundings.

    python -m experiments.world_size --sides 12 30 60 120

A floor of rooms of 6 m with doors, all of it mapped but for a corner of the robot's own room; the
robot observes a frame of 256 px and decides with `r3-pano`. By tiles, and in one table where that
has room for the world. Medians of wall time, on a machine without other work; for a block that
moves until the next frame can join, and until all that it leaves behind is scored. Writes a table
and a figure.
"""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import r3jax
from r3jax.geometry.cameras import pixel_rays
from r3jax.mapping.tile_files import Voxels
from r3jax.mapping.tiles import Layer, Rows, Tile, packed_index, packed_layer, table_of, tile_rows
from r3jax.planning.planner import Planner, at_hand

ROOM, HEIGHT, DOOR = 6.0, 2.6, 1.2
"""Edge and height of a room, width of a door [m]."""

BLOCK = 30.0
"""Rooms and tiles of 5 m repeat after this many meters."""

LARGEST_TABLE = 1 << 23
"""Rows of the largest table that is tried in one piece; 2^24 are more than it can have."""


def surfaces(side: float, size: float = 0.05) -> np.ndarray:
    """Lists the voxels of floor, ceiling and walls of a square of rooms, [3, n] int."""
    num, room, tall = round(side / size), round(ROOM / size), round(HEIGHT / size)
    x, y = (a.ravel() for a in np.meshgrid(np.arange(num), np.arange(num), indexing="ij"))
    levels = [np.stack([x, y, np.full_like(x, z)]) for z in (0, tall)]
    line, z = (a.ravel() for a in np.meshgrid(np.arange(num), np.arange(1, tall), indexing="ij"))
    is_wall = (np.abs(line % room - room // 2) > DOOR / size / 2) | (z * size > 2.0)
    walls: list[np.ndarray] = []
    for at in range(0, num + 1, room):
        keep = is_wall if 0 < at < num else np.ones_like(is_wall)
        fixed = np.full(int(keep.sum()), at)
        walls += [np.stack([fixed, line[keep], z[keep]]), np.stack([line[keep], fixed, z[keep]])]
    return np.unique(np.concatenate(levels + walls, axis=1), axis=1)


def rows_of(index: np.ndarray, num_bins: int = 64) -> dict[str, np.ndarray]:
    """Makes up what was seen of voxels [3, n]: some observations of each, from up to three bins."""
    rng, num = np.random.default_rng(0), index.shape[1]
    count = rng.integers(1, 9, num).astype(np.float32)
    visited = np.zeros((num_bins // 32, num), np.uint32)
    for bins in rng.integers(0, num_bins, (3, num)):
        visited[bins // 32, np.arange(num)] |= np.uint32(1) << (bins % 32).astype(np.uint32)
    return {
        "whole": packed_index(index.astype(np.int64)),
        "visited": visited,
        "count": count,
        "mean": np.full((3, num), 0.5, np.float32),
        "m2": (0.01 * (count - 1.0)).astype(np.float32),
        "resolution": np.full(num, 150.0, np.float32),
        "misses": np.zeros(num, np.uint8),
    }


def known(grid: r3jax.OccupancyGrid, side: float, robot: np.ndarray) -> r3jax.OccupancyGrid:
    """Fills in the rooms, but for one corner of the robot's own."""
    size, low = float(grid.cell_size), np.asarray(grid.origin)
    x, y, z = (low[i] + (np.arange(n) + 0.5) * size for i, n in enumerate(grid.log_odds.shape))
    x, y, z = x[:, None, None], y[None, :, None], z[None, None, :]
    inside = (x > 0) & (x < side) & (y > 0) & (y < side) & (z > 0) & (z < HEIGHT)
    line = lambda a: np.minimum(a % ROOM, ROOM - a % ROOM) < 0.1 + 0.5 * size
    door = lambda a: (np.abs(a % ROOM - ROOM / 2) < DOOR / 2) & (z < 2.0)
    wall = (line(x) & ~door(y)) | (line(y) & ~door(x)) | (z < size) | (z > HEIGHT - size)
    corner = robot[:2] - robot[:2] % ROOM + 0.3
    hidden = (np.abs(x - corner[0] - 0.5) < 0.6) & (np.abs(y - corner[1] - 0.5) < 0.6)
    values = np.where(wall, 3.0, -3.0) * (inside & ~hidden)
    return replace(grid, log_odds=jnp.asarray(values, jnp.float32))


def view(robot: np.ndarray, camera: r3jax.Camera) -> r3jax.Frame:
    """Renders the robot's room without its doors."""
    pose = np.asarray(r3jax.pose_along(robot, np.array([1.0, 0.3, -0.1])), np.float64)
    rays = np.asarray(pixel_rays(camera), np.float64) @ pose[:3, :3].T
    low = np.append(robot[:2] - robot[:2] % ROOM, 0.0)
    walls = np.where(rays > 0, low + np.array([ROOM, ROOM, HEIGHT]), low) - robot
    depth = (walls / np.where(np.abs(rays) < 1e-9, 1e-9, rays)).min(axis=2).astype(np.float32)
    rgb = np.full((*depth.shape, 3), 0.5, np.float32)
    return r3jax.Frame(jnp.asarray(rgb), jnp.asarray(depth), jnp.asarray(pose, jnp.float32), camera)


def seconds_of(work: Callable[[], Any], tries: int) -> float:
    """Measures the median of some tries; the first, which compiles, is left out."""
    jax.block_until_ready(work())
    spent = list[float]()
    for _ in range(tries):
        begin = time.perf_counter()
        jax.block_until_ready(work())
        spent.append(time.perf_counter() - begin)
    return float(np.median(spent))


def _seconds_to_move(planner: Planner, there: np.ndarray) -> tuple[float, float]:
    begin = time.perf_counter()
    moved = at_hand(planner, there)
    jax.block_until_ready((moved.map_state, moved.grid))
    until_map = time.perf_counter() - begin
    assert moved.far is not None
    assert moved.far.settled.left is None
    return until_map, time.perf_counter() - begin


def without_tiles(side: float, robot: np.ndarray, camera: r3jax.Camera) -> Planner | None:
    """Makes a planner of one table, or None where that would be too large."""
    if (side / BLOCK) ** 2 * 1.1e6 > 0.69 * LARGEST_TABLE:
        return None
    index = surfaces(side)
    capacity = 1 << int(np.ceil(np.log2(index.shape[1] / 0.69)))
    config = r3jax.MappingConfig(capacity=capacity)
    bounds = [[0.0, 0.0, 0.0], [side, side, HEIGHT]]
    planner = r3jax.start(camera, bounds, config=config)
    state = table_of(rows_of(index), planner.map_state, capacity)
    return replace(planner, map_state=state, grid=known(planner.grid, side, robot))


def by_tiles(side: float, robot: np.ndarray, camera: r3jax.Camera) -> Planner:
    """Makes a planner of tiles: those of one block of rooms, again and again."""
    bounds = np.array([[-np.inf, -np.inf, 0.0], [np.inf, np.inf, HEIGHT]])
    planner = r3jax.start(camera, bounds)
    far = planner.far
    assert far is not None
    lattice, size = far.tiles.lattice, planner.config.voxel_size
    rows = rows_of(surfaces(min(side, BLOCK)))
    some = list(tile_rows(rows, lattice, size))
    voxels: dict[Tile, Rows] = {}
    for x in np.arange(0.0, side, BLOCK):
        for y in np.arange(0.0, side, BLOCK):
            by_cells = np.array([round(x / size), round(y / size), 0])
            dx, dy = round(x / lattice.edge[0]), round(y / lattice.edge[1])
            for (i, j, k), part in some:
                copies = {n: None if a is None else a.copy() for n, a in vars(part).items()}
                copies["box"] = part.box + np.stack([by_cells, 0 * by_cells])
                voxels[i + dx, j + dy, k] = Rows(**copies)
    cells: dict[Tile, dict[str, Layer]] = {}
    last = int(np.ceil(side / lattice.edge[0]))
    for i in range(-1, last + 1):
        for j in range(-1, last + 1):
            corner = np.array(lattice.origin) + np.array([i, j, 0]) * lattice.edge
            empty = r3jax.OccupancyGrid(
                jnp.zeros(lattice.cells), jnp.asarray(corner, jnp.float32), planner.grid.cell_size
            )
            values = np.asarray(known(empty, side, robot).log_odds)
            if values.any():
                cells[i, j, 0] = {"log_odds": packed_layer(values)}
    tiles = replace(far.tiles, middle=(9999, 0, 0), voxels=Voxels(voxels), cells=cells)
    return at_hand(replace(planner, far=replace(far, tiles=tiles)), robot)


@dataclass(frozen=True)
class Options:
    """What to measure."""

    sides: Sequence[float] = (12.0, 30.0, 60.0, 120.0)
    """Edges of the square floors [m]."""

    tries: int = 7
    """Of which the median counts."""

    out: Path = Path("experiments/results/world_size")
    """Folder of the table and the figure."""


def measured(planner: Planner, robot: np.ndarray, frame: r3jax.Frame, tries: int) -> dict[str, Any]:
    """Measures a frame, a decision, and, by tiles, crossing a border."""
    after = r3jax.observe(planner, frame)
    key = jax.random.key(1)
    milliseconds = {
        "observe": seconds_of(lambda: r3jax.observe(planner, frame).map_state, tries),
        "decide": seconds_of(
            lambda: r3jax.decide(after, frame.T_world_camera, key)[0] and 0, tries
        ),
    }
    far = planner.far
    if far is not None:
        there = robot + np.array([far.tiles.lattice.edge[0] + 1.0, 0.0, 0.0])
        moves = [_seconds_to_move(planner, there) for _ in range(tries + 1)]
        names = ("block moves", "and its views are scored")
        milliseconds |= dict(zip(names, np.median(moves[1:], axis=0), strict=True))
    found = {f"{name} [ms]": round(1e3 * x, 1) for name, x in milliseconds.items()}
    found["rows"] = planner.map_state.capacity
    found["voxels"] = int(planner.map_state.num_present)
    if far is not None:
        found["voxels"] += far.tiles.num_voxels
        found["bytes a far voxel"] = round(far.tiles.nbytes / max(far.tiles.num_voxels, 1), 1)
    return found


def main(options: Options) -> Path:
    """Measures, writes the table and the figure, and returns their folder."""
    camera = r3jax.Camera.from_fov(256, 256, 60.0)
    records: list[dict[str, Any]] = []
    for side in options.sides:
        robot = np.array([side // 12 * 6 + 3.3, side // 12 * 6 + 3.1, 1.3])
        frame = view(robot, camera)
        for kind, make in (("tiles", by_tiles), ("one table", without_tiles)):
            planner = make(side, robot, camera)
            if planner is not None:
                found = measured(planner, robot, frame, options.tries)
                records.append({"side [m]": side, "map": kind} | found)
                print(json.dumps(records[-1]), flush=True)
    options.out.mkdir(parents=True, exist_ok=True)
    text = "".join(json.dumps(record) + "\n" for record in records)
    (options.out / "cost.jsonl").write_text(text)
    draw(options.out)
    return options.out


def draw(folder: Path) -> None:
    """Draws cost against the number of voxels, from the table in a folder."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

    rows = [json.loads(line) for line in (folder / "cost.jsonl").read_text().splitlines()]
    # The latest of each: a side that is given twice warms up.
    records = list({(r["side [m]"], r["map"]): r for r in rows}.values())
    figure = Figure(figsize=(7.0, 3.2), layout="constrained")
    for axes, part in zip(figure.subplots(1, 2), ("observe", "decide"), strict=True):
        for kind, marker in (("one table", "s--"), ("tiles", "o-")):
            points = [(r["voxels"], r[f"{part} [ms]"]) for r in records if r["map"] == kind]
            axes.loglog(*zip(*points, strict=True), marker, label=kind)
        axes.set(xlabel="voxels of the world", ylabel=f"{part} [ms]")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:.0f}"))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.grid(alpha=0.3)
    figure.axes[1].legend(loc="upper right")
    figure.savefig(folder / "cost.png", dpi=120)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
