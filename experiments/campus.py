"""Explores a floor of many rooms by tiles: cost of each step, memory, and a plan of what was found.

    python -m experiments.campus --rooms 6 --views 200

Rooms of 6 m with doors in every wall and some boxes, drawn by the ray caster; `r3-pano` starts in a
corner, without bounds but for floor and ceiling. A row of `steps.jsonl` for each view.
"""

import json
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import trimesh
import tyro

import r3jax
from experiments.world_size import DOOR, HEIGHT, ROOM
from r3jax.exploration.state import compilations
from r3jax.mapping.occupancy import FREE_LOG_ODDS, OCCUPIED_LOG_ODDS
from r3jax.mapping.tiles import unpacked_layer
from r3jax.mapping.update import integrate_growing
from r3jax.planning.far import Far
from r3jax.planning.planner import Planner, first_map
from r3jax.simulators.scenes.registry import open_scene

_WALL = 0.1


@dataclass(frozen=True)
class Options:
    """What to explore."""

    rooms: int = 6
    """Rooms along each side."""

    views: int = 200
    """Views to take."""

    edge: int = 128
    """Width and height of the images [px]."""

    seed: int = 0
    """Of the boxes, the colors and the decisions."""

    check: bool = False
    """Map all frames in one table, too, and compare it with the tiles at the end."""

    out: Path = Path("experiments/results/campus")
    """Folder of the rows and the plan."""


def boxes(rooms: int, seed: int) -> list[np.ndarray]:
    """Lists floor, ceiling, walls with doors, and furniture, each [2, 3] [m]."""
    side, rng = rooms * ROOM, np.random.default_rng(seed)
    low, high = -_WALL / 2, side + _WALL / 2
    found = [np.array([[low, low, z], [high, high, z + _WALL]]) for z in (-_WALL, HEIGHT)]
    first, last = (ROOM - DOOR) / 2, (ROOM + DOOR) / 2
    for axis in (0, 1):
        for line in range(rooms + 1):
            for room in range(rooms):
                # Beside the door, beyond it, and above it; outer walls have none.
                pieces = [(0.0, first, 0.0), (last, ROOM, 0.0), (first, last, 2.0)]
                for begin, end, foot in pieces if 0 < line < rooms else [(0.0, ROOM, 0.0)]:
                    box = np.zeros((2, 3))
                    box[:, axis] = line * ROOM - _WALL / 2, line * ROOM + _WALL / 2
                    box[:, 1 - axis] = room * ROOM + begin, room * ROOM + end
                    box[:, 2] = foot, HEIGHT
                    found.append(box)
    for x in range(rooms):
        for y in range(rooms):
            for corner in rng.permutation(4)[: rng.integers(1, 4)]:
                size = rng.uniform(0.5, 1.4, 3)
                at = np.array([corner // 2, corner % 2]) * (ROOM - 0.4 - size[:2]) + 0.2
                at += np.array([x, y]) * ROOM
                found.append(np.array([[*at, 0.0], [*(at + size[:2]), size[2]]]))
    return found


def write_world(path: Path, rooms: int, seed: int) -> str:
    """Writes the mesh, and returns its name for `open_scene`."""
    rng = np.random.default_rng(seed)
    meshes = []
    for low, high in boxes(rooms, seed):
        mesh = trimesh.creation.box(bounds=[low, high])
        mesh = mesh.subdivide_to_size(1.5)
        colors = rng.integers(40, 255, 3) + rng.integers(-30, 30, (len(mesh.vertices), 3))
        mesh.visual.vertex_colors = colors.clip(0, 255).astype(np.uint8)
        meshes.append(mesh)
    trimesh.util.concatenate(meshes).export(path)
    return f"mesh:{path}"


def plan_of(planner: Planner, height: float, side: float) -> np.ndarray:
    """Assembles a level slice of all cells: 0 unknown, 1 free, 2 occupied, [x, y]."""
    far = planner.far
    assert far is not None
    lattice = far.tiles.lattice
    layer = int((height - lattice.origin[2]) / lattice.cell_size)
    num = int(np.ceil(side / lattice.cell_size))
    plan = np.zeros((num, num), np.float32)

    def put(values: np.ndarray, first: np.ndarray) -> None:
        for x, y in np.ndindex(values.shape[:2]):
            i, j = first[0] + x, first[1] + y
            if 0 <= i < num and 0 <= j < num:
                plan[i, j] = values[x, y, layer]

    for tile, layers in far.tiles.cells.items():
        if "log_odds" in layers:
            put(unpacked_layer(layers["log_odds"], lattice.cells),
                np.array(tile) * np.array(lattice.cells))  # fmt: skip
    put(np.asarray(planner.grid.log_odds), far.first_cell)
    return np.where(plan < FREE_LOG_ODDS, 1, np.where(plan > OCCUPIED_LOG_ODDS, 2, 0))


def main(options: Options) -> Path:
    """Explores, and writes rows and a plan."""
    options.out.mkdir(parents=True, exist_ok=True)
    side = options.rooms * ROOM
    spec = write_world(options.out / "world.ply", options.rooms, options.seed)
    camera = r3jax.Camera.from_fov(options.edge, options.edge, 75.0)
    pose = np.asarray(r3jax.pose_along(np.array([2.6, 2.4, 1.3]), np.array([1.0, 0.6, 0.0])))
    pose = pose.astype(np.float64)
    simulator = open_scene(spec, camera=camera, start_pose=pose)
    floor = [[-np.inf, -np.inf, -0.1], [np.inf, np.inf, HEIGHT + 0.1]]
    planner = r3jax.start(camera, floor, starts=[pose])
    rows, metres, places = [], 0.0, [pose[:3, 3]]
    whole = first_map(replace(planner.config, capacity=1 << 20)) if options.check else None
    for step in range(options.views):
        frame = simulator.render(pose)
        if whole is not None:
            whole = integrate_growing(whole, frame, planner.config.max_range)
        times = [time.process_time()]
        planner = r3jax.observe(planner, frame)
        jax.block_until_ready(planner.map_state)
        times.append(time.process_time())
        key = jax.random.fold_in(jax.random.key(options.seed), step)
        decision, planner, info = r3jax.decide(planner, pose, key)
        times.append(time.process_time())
        rows.append(
            row_of(planner, metres, times) | {"step": step, "position": pose[:3, 3].tolist()}
        )
        with open(options.out / "steps.jsonl", "a") as file:
            file.write(json.dumps(rows[-1]) + "\n")
        if decision is None:
            print(info.outcome, info.reason)
            break
        metres += decision.length
        places += list(decision.waypoints[1:])
        pose = decision.T_world_camera
    draw(planner, np.array(places), side, options.out / "plan.png")
    if whole is not None:
        print("differences", differences(planner.whole_map, whole))
    return options.out


def differences(a: r3jax.MapState, b: r3jax.MapState) -> dict[str, int]:
    """Counts the numbers in which two maps differ, voxel by voxel."""
    found = []
    for state in (a, b):
        rows = np.flatnonzero(np.asarray(state.present))
        order = rows[np.lexsort(np.asarray(state.key)[:, rows])]
        names = ("key", "visited", "count", "mean", "m2", "resolution", "misses")
        found.append({name: np.asarray(getattr(state, name))[..., order] for name in names})
    if found[0]["count"].shape != found[1]["count"].shape:
        return {"voxels": abs(found[0]["count"].size - found[1]["count"].size)}
    return {name: int((found[0][name] != found[1][name]).sum()) for name in found[0]}


def row_of(planner: Planner, metres: float, times: list[float]) -> dict[str, Any]:
    """Describes a step in numbers."""
    far = planner.far
    assert isinstance(far, Far)
    return {
        "observe": round(times[1] - times[0], 4),
        "decide": round(times[2] - times[1], 4),
        "metres": round(metres, 2),
        "rows": planner.map_state.capacity,
        "active": int(planner.map_state.num_present),
        "far": far.tiles.num_voxels,
        "far_bytes": far.tiles.nbytes,
        "views_left": len(far.views.path),
        "trail": len(far.trails),
        "compiled": compilations.count,
    }


def draw(planner: Planner, places: np.ndarray, side: float, path: Path) -> None:
    """Draws the plan, and where the camera went."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.0, 6.0), layout="constrained")
    axes = figure.subplots()
    plan = plan_of(planner, 1.3, side)
    shades = np.array([0.75, 1.0, 0.1])[plan]
    axes.imshow(shades.T, cmap="gray", vmin=0, vmax=1, origin="lower", extent=(0, side, 0, side))
    axes.plot(places[:, 0], places[:, 1], "-", color="tab:red", linewidth=0.8)
    axes.plot(*places[0, :2], "o", color="tab:blue")
    axes.set(xlabel="x [m]", ylabel="y [m]")
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
