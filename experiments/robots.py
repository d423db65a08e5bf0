"""Robots that drive through true meshes: how much of the place each reaches, and what it touches.

    python -m experiments.robots --scenes flat office house --decisions 60

A robot has a footprint, a camera at a height with a tilt and a lens, and nothing but `start`,
`observe` and `decide`. The box of the space begins at the floor. What it could have reached is
searched for on the mesh: a raster of 2 cm of everything between 10 cm above the floor and the top
of the robot, widened by the footprint, and what connects to the start.

*Visited* is what lies within a meter of the robot's path, measured round obstacles. With
`--settings lidar` it has a LiDAR, too, of which a costmap is made that is trusted where it is free.
"""

import itertools
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import trimesh
import tyro
from scipy import ndimage

import r3jax
from r3jax.geometry.cameras import Camera, pose_along
from r3jax.planning.decide import look_round
from r3jax.planning.robot.motion import Motion, make_motion
from r3jax.simulators.base import NoisySimulator
from r3jax.simulators.raycast.raycast import RaycastSimulator
from r3jax.simulators.scenes.registry import open_world
from r3jax.simulators.world import World

PIXEL = 0.02
"""Side of a pixel of the plan of the true mesh [m]."""

LOW = 0.1
"""What is no higher above the floor is driven over [m]."""

NEAR = 1.0
"""What lies this near to the robot's path, round obstacles, was visited [m]."""

SIZE = (256, 192)
"""Pixels of the images."""

LIDAR = 0.2, 8.0
"""Height of a LiDAR's plane above the floor, and its range [m]."""

HOUSE = "mesh:experiments/scenes/aws_small_house/aws_small_house.glb"

LENSES = {"40x30": (40.0, 30.0), "69x42": (69.0, 42.0), "90x74": (90.0, 74.0)}
"""Horizontal and vertical fields of view [degrees]; the middle one is a RealSense D435's colors."""


@dataclass(frozen=True)
class Robot:
    """A robot on wheels with a camera that is fixed to it."""

    height: float = 0.3
    """Of the camera above the floor [m]."""

    tilt: float = 0.0
    """Of the camera above the horizon [degrees]."""

    lens: str = "69x42"

    footprint: float = 0.2
    """Radius [m]."""

    body: float | None = None
    """How far it reaches down from the camera [m]; None: to the floor."""

    @property
    def low(self) -> float:
        """Lowest part of the body above the floor [m]."""
        return 0.0 if self.body is None else max(0.0, self.height - self.body)

    @property
    def camera(self) -> Camera:
        """Of one size for all lenses, so that programs compile once."""
        (width, height), angles = SIZE, np.radians(LENSES[self.lens])
        fx, fy = (0.5 * n / np.tan(0.5 * a) for n, a in zip(SIZE, angles, strict=True))
        return Camera(width, height, float(fx), float(fy), width / 2, height / 2)


@dataclass(frozen=True)
class Plan:
    """The true mesh seen from above."""

    origin: np.ndarray
    """Lower corner [m], [2]."""

    distance: np.ndarray
    """From each pixel to the nearest obstacle [m], [X, Y]."""

    def at(self, points: np.ndarray) -> np.ndarray:
        """Distances of points [n, 2+] to the nearest obstacle [m]."""
        x, y = self.pixel(points).T
        return self.distance[x, y]

    def pixel(self, points: np.ndarray) -> np.ndarray:
        """Pixels of points [n, 2+], [n, 2]."""
        index = np.floor((np.asarray(points)[:, :2] - self.origin) / PIXEL).astype(int)
        return np.clip(index, 0, np.array(self.distance.shape) - 1)

    def center(self, pixel: np.ndarray) -> np.ndarray:
        """Center of a pixel [2] [m]."""
        return self.origin + (np.asarray(pixel) + 0.5) * PIXEL

    def reachable(self, radius: float, start: np.ndarray) -> np.ndarray:
        """Where the middle of a disk can come from `start`, [X, Y] bool."""
        labels, _ = ndimage.label(self.distance >= radius)
        here = labels[tuple(self.pixel(start[None])[0])]
        return (labels == here) & (here > 0)


_SURFACES: dict[str, np.ndarray] = {}


def surface_of(world: World) -> np.ndarray:
    """Points on a mesh, one per square centimeter: the thinnest leg of a chair gets dozens."""
    if world.name not in _SURFACES:
        _SURFACES.clear()  # one world at a time: a house has four million points
        mesh = trimesh.Trimesh(world.vertices, world.faces, process=False)
        _SURFACES[world.name], _ = trimesh.sample.sample_surface(mesh, int(mesh.area * 1e4), seed=0)
    return _SURFACES[world.name]


def plan_of(world: World, floor: float, low: float, high: float) -> Plan:
    """Draws everything of a mesh that lies between two heights above the floor [m]."""
    points = surface_of(world)
    z = points[:, 2] - floor
    points = points[(z > max(low, LOW)) & (z < high)]
    origin = world.bounds[0, :2]
    shape = np.ceil((world.bounds[1, :2] - origin) / PIXEL).astype(int) + 1
    is_open = np.ones(shape, dtype=bool)
    x, y = np.floor((points[:, :2] - origin) / PIXEL).astype(int).T
    is_open[x, y] = False
    is_open[[0, -1]] = is_open[:, [0, -1]] = False
    return Plan(origin, ndimage.distance_transform_edt(is_open) * PIXEL)


def near_path(reachable: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """What of the reachable pixels lies within `NEAR` of some others, round obstacles."""
    near = np.zeros_like(reachable)
    near[tuple(pixels.T)] = True
    near &= reachable
    cross, square = ndimage.generate_binary_structure(2, 1), np.ones((3, 3), bool)
    for i in range(int(NEAR / PIXEL / 1.2)):  # crosses and squares in turn: nearly a disk
        near = ndimage.binary_dilation(near, square if i % 2 else cross, mask=reachable)
    return near


def along(waypoints: np.ndarray) -> np.ndarray:
    """Points every centimeter along a path [K, 3]."""
    parts = [waypoints[:1]]
    for a, b in itertools.pairwise(waypoints):
        num = max(int(np.ceil(np.linalg.norm(b - a) / 0.01)), 1)
        parts.append(a + (b - a) * (np.arange(1, num + 1) / num)[:, None])
    return np.concatenate(parts)


def before(robot: Robot) -> dict[str, Any]:
    """Settings of a policy as they were: a ball of known free cells, and a body below it."""
    body = max(0.0, robot.height - 0.1) if robot.body is None else robot.body
    return {"motion": _motion(robot, body=body)}


def after(robot: Robot) -> dict[str, Any]:
    """Settings of a policy with a footprint."""
    body = r3jax.Body(footprint=robot.footprint, heights=(robot.low, robot.height))
    return {"motion": _motion(robot, body=body)}


class Lidar:
    """A LiDAR that sweeps a plane, and the costmap made of its scans."""

    def __init__(self, world: World, floor: float):
        height, self.reach = LIDAR
        self.plan = plan_of(world, floor, height - 0.05, height + 0.05)
        self.costs = np.full(self.plan.distance.shape, -1, np.int8)

    def scan(self, place: np.ndarray) -> np.ndarray:
        """Adds a scan of 1,440 rays from a place [2] [m]; the costmap, [height, width]."""
        angles = np.linspace(0.0, 2.0 * np.pi, 1440, endpoint=False)
        ways = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        steps = np.arange(0.0, self.reach, 0.5 * PIXEL)
        points = place + steps[:, None, None] * ways
        at = self.plan.pixel(points.reshape(-1, 2)).reshape(points.shape)
        hits = self.plan.distance[at[..., 0], at[..., 1]] <= 0.0
        is_free = np.cumsum(hits, axis=0) == 0
        is_first = hits & (np.cumsum(hits, axis=0) == 1)
        self.costs[tuple(at[is_free].T)] = 0
        self.costs[tuple(at[is_first].T)] = 100
        return self.costs.T


def _motion(robot: Robot, **body: Any) -> Motion:
    return make_motion("ground", elevations=(robot.tilt, robot.tilt), **body)


def start_of(plan: Plan, radius: float) -> np.ndarray:
    """The pixel farthest from all obstacles, of the largest part that the disk can move in."""
    labels, _ = ndimage.label(plan.distance >= radius)
    sizes = np.bincount(labels.ravel())
    largest = labels == 1 + np.argmax(sizes[1:])
    return np.array(np.unravel_index(np.argmax(plan.distance * largest), largest.shape))


def open_bounds(world: World, floor: float) -> np.ndarray:
    """The box of the mesh, from the floor on."""
    bounds = np.array(world.bounds)
    bounds[0, 2] = floor
    return bounds


def pose_of(robot: Robot, place: np.ndarray, floor: float) -> np.ndarray:
    """Pose of the camera of a robot that stands at a place [2] and faces along x, [4, 4]."""
    tilt = np.radians(robot.tilt)
    eye, ahead = (*place, floor + robot.height), (np.cos(tilt), 0.0, np.sin(tilt))
    return np.asarray(pose_along(np.array(eye, np.float32), np.array(ahead, np.float32)), float)


def drive(
    world: World, robot: Robot, settings: dict[str, Any], decisions: int, *, floor: float = 0.0,
    policy: str = "r3-pano", seed: int = 0, lidar: Lidar | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Drives one robot through a world; what it visited, and what it touched."""
    plan = plan_of(world, floor, robot.low, robot.height)
    pose = pose_of(robot, plan.center(start_of(plan, robot.footprint)), floor)
    inner = RaycastSimulator(world, robot.camera, start_pose=None, max_range=5.0)
    simulator = NoisySimulator(inner, 0.01, seed)
    chosen = r3jax.make_policy(policy, num_candidates=60, num_frontier=20, **settings)
    config = r3jax.MappingConfig(capacity=1 << 16)
    planner = r3jax.start(robot.camera, open_bounds(world, floor), chosen, starts=[pose],
                          config=config)  # fmt: skip
    paths, goals, outcomes, seconds = [pose[None, :3, 3]], [], [], []
    reason, views = "", [[*pose[:3, 3].round(3).tolist(), *pose[:3, 2].round(3).tolist()]]
    for key in jax.random.split(jax.random.key(seed), decisions):
        planner = r3jax.observe(planner, simulator.render(pose.astype(np.float32)))
        if lidar is not None:
            costs, origin = lidar.scan(pose[:2, 3]), lidar.plan.origin
            planner = r3jax.with_costmap(planner, costs, PIXEL, origin, trust_free=True)
        jax.block_until_ready(planner)  # the frame is in the map before the clock starts
        begin = time.perf_counter()
        decision, planner, info = r3jax.decide(planner, pose, key)
        seconds.append(time.perf_counter() - begin)
        outcomes.append(info.outcome.value)
        reason = getattr(info, "reason", "") or reason
        if decision is None:
            break
        paths.append(along(decision.waypoints))
        goals.append(decision.length)
        pose = decision.T_world_camera
        views.append([*pose[:3, 3].round(3).tolist(), *pose[:3, 2].round(3).tolist()])
    track = np.concatenate(paths)
    reachable = plan.reachable(robot.footprint, track[0])
    visited = near_path(reachable, plan.pixel(track))
    nearest = float(plan.at(track).min())
    # What the planner holds for reachable in the end, visited or not.
    state, situation = look_round(planner.policy_state, planner.map_state, planner.grid, pose,
                                  chosen.config)  # fmt: skip
    columns = situation.travel.reachable.any(axis=2)
    centers = plan.origin + (np.argwhere(reachable) + 0.5) * PIXEL
    cells = np.floor((centers - situation.travel.origin[:2]) / situation.travel.cell_size)
    is_open = columns[tuple(cells.astype(int).T)]
    del state
    return {
        "open": float(is_open.mean()),
        "decisions": len(outcomes),
        "outcome": outcomes[-1],
        "reason": reason,
        "visited": float(visited.sum() / max(reachable.sum(), 1)),
        "reachable_m2": float(reachable.sum() * PIXEL**2),
        "meters": float(np.sum(goals)),
        "nearest": nearest,
        "nearest_at": track[np.argmin(plan.at(track))].round(3).tolist(),
        # Half a diagonal of a pixel is what the plan itself may be wrong by.
        "collides": bool(nearest < robot.footprint - 0.75 * PIXEL),
        "decide_median": float(np.median(seconds)),
        "views": views,
        "track": track[:: max(len(track) // 800, 1)].round(3).tolist(),
    }


def scene_world(name: str) -> World:
    """The embedded scene, or the house."""
    return open_world(HOUSE if name == "house" else name)


def robots(kind: str) -> list[Robot]:
    """Heights, tilts and lenses: each alone, and the corners."""
    middle = [Robot(height=h) for h in (0.2, 0.3, 0.6, 0.9, 1.5)]
    tilted = [Robot(height=h, tilt=t) for h in (0.3, 0.9, 1.5) for t in (-30.0, -20.0, 10.0)]
    lenses = [Robot(height=h, lens=lens) for h in (0.3, 0.9) for lens in ("40x30", "90x74")]
    corners = [Robot(height=h, tilt=t, lens=lens) for h in (0.2, 1.5) for t in (-30.0, 10.0)
               for lens in ("40x30", "90x74")]  # fmt: skip
    bodies = [Robot(height=h, body=b) for h, b in ((0.6, 0.0), (0.9, 0.4))]
    if kind == "few":
        return [Robot(height=0.3), Robot(height=0.6), Robot(height=0.9, tilt=-20.0),
                Robot(height=1.5, tilt=-30.0, lens="40x30")]  # fmt: skip
    return [*middle, *tilted, *lenses, *corners, *bodies]


@dataclass(frozen=True)
class Options:
    """What is driven."""

    scenes: tuple[str, ...] = ("flat", "office", "house")
    decisions: int = 60
    which: str = "all"
    """`few` or `all`."""
    settings: str = "after"
    """`before`: the ball of known free cells; `after`: the footprint; `lidar`: a LiDAR, too."""
    out: Annotated[Path, tyro.conf.arg(help="A line of JSON for each drive is added.")] = Path(
        "robots.jsonl"
    )


def main(options: Options) -> None:
    """Drives all robots in all scenes that the file does not hold yet."""
    done = set()
    if options.out.exists():
        for line in options.out.read_text().splitlines():
            row = json.loads(line)
            done.add((row["scene"], row["settings"], json.dumps(row["robot"], sort_keys=True)))
    for scene in options.scenes:
        world = scene_world(scene)
        for robot in robots(options.which):
            cell = (scene, options.settings, json.dumps(asdict(robot), sort_keys=True))
            if cell in done:
                continue
            begin = time.perf_counter()
            settings = (before if options.settings == "before" else after)(robot)
            lidar = Lidar(world, 0.0) if options.settings == "lidar" else None
            result = drive(world, robot, settings, options.decisions, lidar=lidar)
            row = {"scene": scene, "settings": options.settings, "robot": asdict(robot), **result}
            with open(options.out, "a") as file:
                file.write(json.dumps(row) + "\n")
            row.pop("track")
            print(f"{time.perf_counter() - begin:.0f} s", json.dumps(row), flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options))
