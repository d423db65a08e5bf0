"""An embedded scene, scanned until its map is full, and what rays on its mesh say is visible."""

import itertools
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

import r3jax
from r3jax.geometry.cameras import Camera, pose_along
from r3jax.geometry.sphere import fibonacci_lattice, octahedral_direction
from r3jax.mapping.state import MapState
from r3jax.simulators.raycast.raycast import RaycastSimulator
from r3jax.simulators.raycast.rays import TriangleScene
from r3jax.simulators.scenes import procedural

CAPACITY = 1 << 18
NEAREST, FARTHEST = 1.0, 4.0
"""Distances between which visibility is compared [m]."""

BORDER = 0.005
"""A hit this close to a voxel's border counts for both sides: a coin toss otherwise [m]."""


@dataclass
class ScannedScene:
    """A scene with its map."""

    simulator: RaycastSimulator
    rays: TriangleScene
    state: MapState
    centers: np.ndarray
    """Centers of the voxels [capacity, 3] [m]; NaN where there is none."""

    stations: np.ndarray
    """Places in the open from which the scene was looked at all round, [n, 3] [m]."""

    @property
    def voxel_size(self) -> float:
        return float(self.state.voxel_size)

    @property
    def rows(self) -> np.ndarray:
        """Rows that hold a voxel."""
        return np.flatnonzero(np.isfinite(self.centers[:, 0]))

    @property
    def _corner(self) -> np.ndarray:
        return np.floor(self.simulator.bounds[0] / self.voxel_size).astype(int) - 2

    @property
    def _extent(self) -> tuple[int, ...]:
        top = np.ceil(self.simulator.bounds[1] / self.voxel_size).astype(int) + 2
        return tuple(int(n) for n in top - self._corner)

    def free_positions(self, num: int, seed: int) -> np.ndarray:
        """Places in the open, 0.4 m from everything, [num, 3] [m]."""
        rng = np.random.default_rng(seed)
        low, high = self.simulator.bounds
        found: list[np.ndarray] = []
        while len(found) < num:
            points = rng.uniform(low + 0.4, high - 0.4, size=(64, 3))
            points = points[self.simulator.clearance(points) > 0.4]
            found += [p for p in points if not self._is_inside_something(p)]
        return np.array(found[:num])

    def _is_inside_something(self, position: np.ndarray) -> bool:
        probes = fibonacci_lattice(64).astype(np.float32)
        hits = self.rays.cast(np.repeat(position[None].astype(np.float32), 64, axis=0), probes)
        return bool(hits.is_back.mean() > 0.3 or np.isinf(hits.distance).any())

    def hit_rows(self, position: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """True for rows of the map on which a ray from the position ends, [capacity]."""
        origins = np.repeat(position[None].astype(np.float32), len(directions), axis=0)
        distance = self.rays.cast(origins, directions.astype(np.float32)).distance
        is_hit = np.isfinite(distance)
        points = position + directions[is_hit] * distance[is_hit, None]
        low = np.floor((points - BORDER) / self.voxel_size).astype(int) - self._corner
        high = np.floor((points + BORDER) / self.voxel_size).astype(int) - self._corner
        is_seen = np.zeros(self._extent, dtype=bool)
        for which in itertools.product((low, high), repeat=3):
            is_seen[tuple(side[:, axis] for axis, side in enumerate(which))] = True
        index = np.floor(self.centers[self.rows] / self.voxel_size).astype(int) - self._corner
        seen_rows = np.zeros(self.state.capacity, dtype=bool)
        seen_rows[self.rows] = is_seen[tuple(index.T)]
        return seen_rows

    def in_range(self, position: np.ndarray) -> np.ndarray:
        """Rows of seen voxels between 1 and 4 m from the position, [capacity]."""
        distance = np.linalg.norm(self.centers - position, axis=1)
        return (distance > NEAREST) & (distance < FARTHEST)


def scan(name: str, num_frames: int, num_stations: int, seed: int = 0) -> ScannedScene:
    """Integrates wide views from free places in random directions, then looks all round from
    some stations: around them the map has no holes, so that only occlusion is compared."""
    world = procedural.build(name)
    simulator = RaycastSimulator(world, Camera.from_fov(192, 192, 100.0), supersample=0)
    # Where depth sensors fail, the map has nothing and looks through: so do the rays.
    holes = np.array([m.is_hole for m in world.materials])[world.face_material]
    rays = TriangleScene(world.vertices, world.faces[~holes])
    blank = np.full((CAPACITY, 3), np.nan)
    scene = ScannedScene(simulator, rays, r3jax.empty_map(CAPACITY), blank, np.zeros((0, 3)))
    scene.stations = scene.free_positions(num_stations, seed + 2)
    places = scene.free_positions(num_frames, seed)
    directions = np.random.default_rng(seed + 1).standard_normal((num_frames, 3))
    around = np.concatenate([np.eye(3), -np.eye(3)])
    looks = [*zip(places, directions, strict=True), *itertools.product(scene.stations, around)]
    for place, direction in looks:
        pose = pose_along(jnp.asarray(place, jnp.float32), jnp.asarray(direction, jnp.float32))
        frame = simulator.render(np.asarray(pose, dtype=np.float64))
        scene.state = r3jax.integrate(scene.state, frame)
    assert int(scene.state.dropped) == 0
    seen = np.asarray(scene.state.count) > 0
    scene.centers = np.where(seen[:, None], np.asarray(scene.state.center).T, np.nan)
    return scene


def sphere_of_rays(side: int) -> np.ndarray:
    """Unit directions through the pixels of an octahedral map, [side * side, 3]."""
    middles = (np.arange(side) + 0.5) / (0.5 * side) - 1.0
    return octahedral_direction(*np.meshgrid(middles, middles)).reshape(-1, 3)


def f1(predicted: np.ndarray, true: np.ndarray) -> tuple[float, float, float]:
    """F1, precision and recall of two sets."""
    both = (predicted & true).sum()
    return (
        2.0 * both / (predicted.sum() + true.sum()),
        both / predicted.sum(),
        both / true.sum(),
    )
