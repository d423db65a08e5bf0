"""Explores places larger than a house by tiles, and walks through one for an audit.

    python -m experiments.campus explore --scene tower --views 400
    python -m experiments.campus explore --rooms 6 --views 200
    python -m experiments.campus walk --frames 1000

`explore` records a run as `r3jax explore --tiles` does, with `r3-pano`, and beside it what each
view took: a row of `steps.jsonl`, and a picture of the floors, the coverage and the memory. The
campus has rooms of 6 m with doors in every wall and some boxes; other places are embedded scenes.
`walk` writes a capture of a walk through the rooms of a campus, of 20 frames a room, for
`r3jax audit`.
"""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import tyro
from matplotlib.figure import Figure
from PIL import Image

import r3jax
from experiments.world_size import DOOR, HEIGHT, ROOM
from r3jax.exploration.config import ExplorationConfig, parse_budget
from r3jax.exploration.loop import explore
from r3jax.exploration.state import compilations
from r3jax.exploration.taken_views import TakenView, to_integers
from r3jax.formats.nerfstudio import OPENGL_FROM_OPENCV
from r3jax.mapping.update import integrate_growing
from r3jax.planning.planner import Planner, first_map
from r3jax.runs.begin import begin_run, resume_run
from r3jax.runs.settings import RunSettings, SceneSettings
from r3jax.simulators.scenes.registry import open_scene

_WALL = 0.1

_EYES = {"tower": (1.3, 4.6, 7.9)}
"""Heights of the floor plans of scenes of several stories [m]."""


@dataclass(frozen=True)
class Explore:
    """Explore a place by tiles."""

    scene: str = "rooms"
    """`rooms`, or an embedded scene."""

    rooms: int = 6
    """Rooms along each side of a campus."""

    views: int = 200
    """Views to take."""

    capture_every: float | None = None
    """Capture frames while moving, at most this far apart [m]."""

    edge: int = 128
    """Width and height of the images [px]."""

    seed: int = 0
    """Of the boxes, the colors and the decisions."""

    check: bool = False
    """Map all frames in one table, too, and compare it with the tiles at the end."""

    resume: bool = False
    """Go on with the run in the folder, to more views."""

    out: Path = Path("experiments/results/campus")
    """Folder of the run, the rows and the picture."""


@dataclass(frozen=True)
class Walk:
    """Write a capture of a walk through the rooms of a campus."""

    frames: int = 1000
    """Frames, 20 a room."""

    width: int = 320
    """Width of the images [px]; the height is three quarters of it."""

    seed: int = 0
    """Of the boxes and the colors."""

    out: Path = Path("experiments/results/campus/walk")
    """Folder of the capture."""


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


def go(options: Explore) -> Path:
    """Explores, and writes the run, rows and a picture."""
    options.out.mkdir(parents=True, exist_ok=True)
    spec, start = options.scene, None
    if spec == "rooms":
        spec = write_world(options.out / "world.ply", options.rooms, options.seed)
        start = (2.6, 2.4, 1.3)
    camera = r3jax.Camera.from_fov(options.edge, options.edge, 75.0)
    policy = r3jax.make_policy("r3-pano")
    config = ExplorationConfig(tiles=True, capture_every=options.capture_every)
    settings = RunSettings(parse_budget(f"views:{options.views}"), config, policy)
    scene = SceneSettings(spec, camera, options.seed, start=start)
    steps, rows = options.out / "steps.jsonl", list[dict[str, Any]]()
    if options.resume:
        expedition = resume_run(options.out / "run", str(settings.budget))
        rows += map(json.loads, steps.read_text().splitlines())
    else:
        expedition = begin_run(settings, scene, options.out / "run", overwrite=True)
        steps.unlink(missing_ok=True)
    state = first_map(replace(config, capacity=1 << 20))
    begin = time.perf_counter() - (rows[-1]["seconds"] if rows else 0.0)

    def on_view(view: TakenView, planner: Planner) -> None:
        nonlocal state
        if options.check:
            state = integrate_growing(
                state, view.frame, config.max_range, drop_edges=config.drop_edges
            )
        rows.append(row_of(view, planner, time.perf_counter() - begin))
        with open(steps, "a") as file:
            file.write(json.dumps(rows[-1]) + "\n")

    with expedition.recorder as recorder:
        result = explore(
            expedition.simulator,
            policy,
            budget=settings.budget,
            seed=options.seed,
            config=expedition.settings.config,
            recorder=recorder,
            resume=expedition.recorded,
            on_view=on_view,
        )
    print(result.message)
    heights = _EYES.get(options.scene, (1.3,))
    draw(result.state.planner, rows, heights, options.out / "plan.png")
    if options.check:
        print("differences", differences(result.state.planner.whole_map, state))
    return options.out


def row_of(view: TakenView, planner: Planner, seconds: float) -> dict[str, Any]:
    """Describes a view in numbers."""
    far, row = planner.far, view.row
    assert far is not None
    path = [] if view.decision is None else view.decision.waypoints.round(2).tolist()
    stages = {name: round(view.stages.get(name, 0.0), 4) for name in ("plan", "map", "measure")}
    return stages | {
        "step": row.step,
        "captured": row.captured,
        "position": row.pose[:3, 3].round(3).tolist(),
        "path": path,
        "seconds": round(seconds, 2),
        "metres": round(row.metres, 2),
        "known_share": round(row.coverage.known_share, 5),
        "rows": planner.map_state.capacity,
        "voxels": row.coverage.voxels,
        "far_bytes": far.tiles.nbytes,
        "trail": len(far.trails),
        "compiled": compilations.count,
        "memory": memory(),
    }


def memory() -> int:
    """Returns the resident memory of this process [bytes]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096


def draw(
    planner: Planner, rows: Sequence[dict[str, Any]], heights: Sequence[float], path: Path
) -> None:
    """Draws a plan of each floor with the path, and coverage and memory over the views."""
    grid, num = planner.whole_grid, len(heights)
    free, occupied = np.asarray(grid.free), np.asarray(grid.occupied)
    origin, size = np.asarray(grid.origin, np.float64), float(grid.cell_size)
    ends = origin[:2] + np.array(free.shape[:2]) * size
    figure = Figure(figsize=(4.2 * max(num, 2), 8.4 if num > 1 else 7.0), layout="constrained")
    upper, lower = np.ravel(figure.subfigures(2, 1, height_ratios=[1.45, 1.0]))
    places = [np.array(row["path"] or [row["position"]]) for row in rows]
    line = np.concatenate(places)
    for axes, height in zip(upper.subplots(1, num, squeeze=False)[0], heights, strict=True):
        z = int((height - origin[2]) / size)
        shade = np.where(free[:, :, z], 1.0, np.where(occupied[:, :, z], 0.1, 0.75))
        axes.imshow(shade.T, cmap="gray", vmin=0, vmax=1, origin="lower",
                    extent=(origin[0], ends[0], origin[1], ends[1]))  # fmt: skip
        near = np.abs(line[:, 2] - height) < 1.65
        axes.plot(*np.where(near, line[:, :2].T, np.nan), "-", color="tab:red", linewidth=0.7)
        if near[0]:
            axes.plot(*line[0, :2], "o", color="tab:blue")
        axes.set(xlabel="x [m]", ylabel="y [m]", title=f"at a height of {height:g} m")
    step = np.arange(1, len(rows) + 1)
    left, right = lower.subplots(1, 2)
    left.plot(step, [100.0 * row["known_share"] for row in rows])
    left.set(xlabel="frames", ylabel="cells of the box that are known [%]", ylim=(0, None))
    right.plot(step, [row["memory"] / 1e6 for row in rows], label="process")
    right.plot(step, [row["far_bytes"] / 1e6 for row in rows], label="tiles that are not active")
    right.set(xlabel="frames", ylabel="memory [MB]", ylim=(0, None))
    right.legend()
    figure.savefig(path, dpi=110)


def walked(rooms: int, frames: int) -> list[np.ndarray]:
    """Lists poses through rooms in rows, back and forth: a turn in each, and steps of 0.5 m."""
    poses: list[np.ndarray] = []
    order = [(x if y % 2 == 0 else rooms - 1 - x, y) for y in range(rooms) for x in range(rooms)]
    centers = (np.array(order) + 0.5) * ROOM
    for here, there in zip(centers, [*centers[1:], centers[-1]], strict=True):
        ahead = np.arctan2(*(there - here)[::-1]) if np.any(there != here) else 0.0
        for k in range(8):
            poses.append(_pose(here, ahead + k * np.pi / 4))
        for k in range(1, 13):
            aside = np.pi / 3 * (k % 3 - 1)
            poses.append(_pose(here + (there - here) * k / 12, ahead + aside))
    return poses[:frames]


def _pose(place: np.ndarray, yaw: float) -> np.ndarray:
    ahead = np.array([np.cos(yaw), np.sin(yaw), -0.15])
    return np.asarray(r3jax.pose_along(np.append(place, 1.5), ahead), np.float64)


def walk(options: Walk) -> Path:
    """Renders the frames of a walk, and writes them as nerfstudio does."""
    rooms = int(np.ceil(np.sqrt(options.frames / 20)))
    for name in ("images", "depth"):
        (options.out / name).mkdir(parents=True, exist_ok=True)
    spec = write_world(options.out.parent / f"{options.out.name}.ply", rooms, options.seed)
    poses = walked(rooms, options.frames)
    camera = r3jax.Camera.from_fov(options.width, options.width * 3 // 4, 75.0)
    simulator = open_scene(spec, camera=camera, start_pose=poses[0], seed=options.seed)
    frames = []
    for number, pose in enumerate(poses):
        rgb, depth = to_integers(simulator.render(pose))
        names = [f"{kind}/{number:06d}.png" for kind in ("images", "depth")]
        for name, pixels in zip(names, (rgb, np.where(depth == 65535, 0, depth)), strict=True):
            Image.fromarray(pixels.astype(rgb.dtype if pixels is rgb else np.uint16)).save(
                options.out / name, compress_level=1
            )
        frames.append({"file_path": names[0], "depth_file_path": names[1],
                       "transform_matrix": (pose @ OPENGL_FROM_OPENCV).tolist()})  # fmt: skip
    lens = {"w": camera.width, "h": camera.height, "fl_x": float(camera.fx),
            "fl_y": float(camera.fy), "cx": float(camera.cx), "cy": float(camera.cy)}  # fmt: skip
    content = lens | {"depth_unit_scale_factor": 1.0 / 5000.0, "frames": frames}
    (options.out / "transforms.json").write_text(json.dumps(content))
    return options.out


def main(options: Explore | Walk) -> Path:
    """Does what a command says, and returns its folder."""
    return go(options) if isinstance(options, Explore) else walk(options)


if __name__ == "__main__":
    print(main(tyro.cli(Explore | Walk, description=__doc__)))
