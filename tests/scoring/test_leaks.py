"""A wall one voxel thick hides what lies behind it, however it stands and wherever one looks."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import r3jax
from r3jax.geometry.cameras import Camera, pose_along
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.visibility.depth_buffer import visible
from r3jax.visibility.views import panorama_view, pinhole_view

CAPACITY = 1 << 15
VOXEL = 0.05
HALF_SIDE = 2.0
"""Half the wall's edge [m]."""

NUM_POINTS = 12 * 24  # behind each wall, at six depths
DEPTHS = np.repeat([0.3, 0.4, 0.6, 1.0, 1.5, 2.0], NUM_POINTS // 6)
"""How far behind the wall the hidden objects are [m]."""

NORMALS = {
    "along x": (1.0, 0.0, 0.0),
    "along -y": (0.0, -1.0, 0.0),
    "along z": (0.0, 0.0, 1.0),
    "45 degrees": (1.0, 1.0, 0.0),
    "45 degrees, leaning": (0.0, 1.0, -1.0),
    "a body diagonal": (1.0, 1.0, 1.0),
    "tilted": (0.83, -0.41, 0.27),
    "tilted a little": (0.99, 0.06, -0.03),
}


class Walled:
    """A wall through a point near the origin, and small objects behind it."""

    def __init__(self, normal: tuple[float, float, float], seed: int = 0) -> None:
        random = np.random.default_rng(seed)
        self.normal = np.array(normal) / np.linalg.norm(normal)
        helper = np.eye(3)[np.argmin(np.abs(self.normal))]
        self.across = np.cross(self.normal, helper)
        self.across /= np.linalg.norm(self.across)
        self.along = np.cross(self.normal, self.across)
        self.middle = random.uniform(0.0, VOXEL, 3)
        steps = np.arange(-HALF_SIDE, HALF_SIDE, VOXEL / 4)  # so dense that no voxel is missed
        u, v = (x.reshape(-1) for x in np.meshgrid(steps, steps))
        wall = self.at(u, v, np.zeros_like(u))
        # Hidden from everywhere in front of the wall's middle: a cone narrower than the wall.
        u, v = random.uniform(-0.25, 0.25, (2, NUM_POINTS))
        hidden = self.at(u, v, -DEPTHS)
        points = np.concatenate([wall, hidden]).astype(np.float32)
        state = r3jax.empty_map(CAPACITY, VOXEL)
        self.state = r3jax.integrate_points(
            state, points, np.full_like(points, 0.5), self.at(0.0, 0.0, 1.0).astype(np.float32)
        )
        assert int(self.state.dropped) == 0
        self.rows = np.asarray(r3jax.lookup(self.state, jnp.asarray(hidden, jnp.float32)))
        self.wall_rows = np.asarray(r3jax.lookup(self.state, jnp.asarray(wall[::7], jnp.float32)))

    def at(self, u, v, w) -> np.ndarray:
        """Points by their coordinates in the wall and along its normal."""
        parts = ((u, self.across), (v, self.along), (w, self.normal))
        return self.middle + sum(np.multiply.outer(x, axis) for x, axis in parts)

    def positions(self, distance: float, num: int, seed: int = 1) -> np.ndarray:
        """Places in front of the wall, at that distance from it, from which it hides all."""
        u, v = np.random.default_rng(seed).uniform(-0.8, 0.8, (2, num)) * min(distance, 1.0)
        return self.at(u, v, np.full(num, distance)).astype(np.float32)


@functools.cache
def walled(name: str) -> Walled:
    return Walled(NORMALS[name])


@jax.jit
def seen_all_round(state, position, config):
    return _seen(state, panorama_view(position, config), config)


@jax.jit
def seen_in_view(state, camera, T_world_camera, config):
    return _seen(state, pinhole_view(camera, T_world_camera, config), config)


def _seen(state, view, config):
    return visible(state.voxels, jnp.zeros((3, 0)), view, config)[0]


CONFIG = r3jax.ScoringConfig(max_range=10.0)
DISTANCES = (0.3, 0.7, 1.5, 4.0)


@pytest.mark.parametrize("name", NORMALS)
@pytest.mark.parametrize("distance", DISTANCES)
def test_nothing_leaks_through_a_wall_all_round(name, distance):
    scene = walled(name)
    for position in scene.positions(distance, 6):
        seen = np.asarray(seen_all_round(scene.state, position, CONFIG))
        assert seen[scene.wall_rows].mean() > 0.3  # it does look at the wall
        leaks = np.unique(DEPTHS[seen[scene.rows]])
        assert leaks.size == 0, f"seen from {position}: what is {leaks} m behind the wall"


@pytest.mark.parametrize("name", NORMALS)
@pytest.mark.parametrize("distance", DISTANCES)
@pytest.mark.parametrize("fov", [60.0, 100.0])
def test_nothing_leaks_through_a_wall_in_a_view(name, distance, fov):
    scene = walled(name)
    camera = Camera.from_fov(512, 512, fov)
    random = np.random.default_rng(2)
    for position in scene.positions(distance, 6):
        direction = scene.middle - position + random.normal(0.0, 0.2, 3) * distance
        pose = pose_along(jnp.asarray(position), jnp.asarray(direction, jnp.float32))
        seen = np.asarray(seen_in_view(scene.state, camera, pose, CONFIG))
        assert seen[scene.wall_rows].any()
        leaks = np.unique(DEPTHS[seen[scene.rows]])
        assert leaks.size == 0, f"seen from {position}: what is {leaks} m behind the wall"


def test_without_the_wall_the_objects_are_seen():
    scene = walled("tilted")
    points = scene.at(np.zeros(3), np.array([-0.2, 0.0, 0.2]), np.array([-0.3, -1.0, -2.0]))
    points = points.astype(np.float32)
    position = scene.positions(1.5, 1)[0]
    state = r3jax.empty_map(CAPACITY, VOXEL)
    state = r3jax.integrate_points(state, points, np.full_like(points, 0.5), position)
    rows = np.asarray(r3jax.lookup(state, jnp.asarray(points)))
    assert np.asarray(seen_all_round(state, position, CONFIG))[rows].all()


@pytest.mark.parametrize("radius", [0.3, 1.0, 2.5])
def test_a_closed_shell_hides_all_directions(radius):
    """From inside a shell, nothing outside is seen: also across the map's borders and poles."""
    random = np.random.default_rng(3)
    sphere = fibonacci_lattice(1 << 17) * radius
    outside = random.standard_normal((1 << 14, 3))
    border = random.standard_normal((1 << 14, 3))
    border[:, 2] = -np.abs(border[:, 2])  # the lower half lies along the borders
    border[::2, 0] *= 1e-3
    border[1::2, 1] *= 1e-3
    outside = np.concatenate([outside, border])
    outside *= (radius + 0.5) / np.linalg.norm(outside, axis=1, keepdims=True)
    position = random.uniform(-0.05, 0.05, 3).astype(np.float32)
    state = r3jax.empty_map(1 << 17, VOXEL)
    for points in (sphere, outside):
        points = points.astype(np.float32)
        state = r3jax.integrate_points(state, points, np.full_like(points, 0.5), position)
    assert int(state.dropped) == 0
    seen = np.asarray(seen_all_round(state, position, CONFIG))
    rows = lambda points: np.asarray(r3jax.lookup(state, jnp.asarray(points, jnp.float32)))
    assert seen[rows(sphere)].mean() > 0.8
    assert not seen[rows(outside)].any()
