"""Nothing leaks through a wall of one voxel, and what is visible agrees with rays on the mesh."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import r3jax
from r3jax.geometry.cameras import Camera, look_at
from r3jax.scoring.views import panorama_view, pinhole_view
from r3jax.scoring.visibility import candidates_of, depth_buffer, visible_voxels
from r3jax.scoring.voxels import voxels_of
from tests.scoring.scanned import f1, scan, sphere_of_rays

CAPACITY = 1 << 15
CAMERA = Camera.from_fov(512, 512, 60.0)
CONFIG = r3jax.ScoringConfig()

NORMALS = {
    "x": (1.0, 0.0, 0.0),
    "z": (0.0, 0.0, 1.0),
    "45 degrees": (1.0, 1.0, 0.0),
    "tilted": (0.62, -0.37, 0.69),
}


def _visible(state, view):
    voxels = voxels_of(state)
    candidates = candidates_of(voxels, view)
    buffer = depth_buffer(voxels, candidates, view, CONFIG)
    return visible_voxels(voxels, candidates, view, buffer).mask


@jax.jit
def seen_all_round(state, position):
    return _visible(state, panorama_view(position, CONFIG))


@jax.jit
def seen_by_camera(state, pose):
    return _visible(state, pinhole_view(CAMERA, pose, CONFIG))


@functools.cache
def _wall(name: str):
    """A wall of one layer of touched voxels, 6 m wide, and a ball 0.35 m behind it or more."""
    normal = np.array(NORMALS[name]) / np.linalg.norm(NORMALS[name])
    first = np.cross(normal, (0.3, 0.5, -0.8))
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    steps = np.arange(-3.0, 3.0, 0.02)
    a, b = (grid.reshape(-1, 1) for grid in np.meshgrid(steps, steps))
    wall = a * first + b * second + 0.013 * normal
    rng = np.random.default_rng(0)
    across = rng.uniform(-0.6, 0.6, (4000, 2))
    behind = across[:, :1] * first + across[:, 1:] * second
    behind = behind - rng.uniform(0.35, 2.0, (4000, 1)) * normal
    state = r3jax.empty_map(CAPACITY)
    for points in (wall, behind):
        points = jnp.asarray(points, dtype=jnp.float32)
        grey = jnp.full_like(points, 0.5)
        state = r3jax.integrate_points(state, points, grey, jnp.asarray(normal, jnp.float32))
    assert int(state.dropped) == 0
    depth = normal @ np.asarray(voxels_of(state).center)
    hidden = (np.asarray(state.count) > 0) & (depth < -0.25)
    assert hidden.sum() > 1000
    return state, hidden, normal, first, second


@pytest.mark.parametrize("name", NORMALS)
@pytest.mark.parametrize("height", [0.3, 1.0, 4.0])
def test_nothing_leaks_through_a_wall_of_one_voxel(name, height):
    state, hidden, normal, first, second = _wall(name)
    wall = (np.asarray(state.count) > 0) & ~hidden
    rng = np.random.default_rng(1)
    for across in rng.uniform(-1.0, 1.0, (6, 2)):
        place = height * normal + across[0] * first + across[1] * second
        position = jnp.asarray(place, dtype=jnp.float32)
        target = jnp.asarray(rng.uniform(-0.5, 0.5, 3), dtype=jnp.float32)
        for visible in (
            np.asarray(seen_all_round(state, position)),
            np.asarray(seen_by_camera(state, look_at(position, target))),
        ):
            assert visible[wall].any()
            assert not visible[hidden].any(), f"{visible[hidden].sum()} voxels leak"


def agreement(name: str, num_places: int) -> np.ndarray:
    """F1, precision and recall of the visible voxels at 1-4 m, averaged over places."""
    scene = scan(name, num_frames=150, num_stations=3)
    rays, scores = sphere_of_rays(1000), []
    for place in [*scene.stations, *scene.free_positions(num_places - 3, seed=77)]:
        near = scene.in_range(place)
        predicted = np.asarray(seen_all_round(scene.state, jnp.asarray(place, jnp.float32)))
        scores.append(f1(predicted & near, scene.hit_rows(place, rays) & near))
    return np.mean(scores, axis=0)


def test_visible_voxels_agree_with_rays_on_the_mesh():
    score, precision, recall = agreement("gallery", num_places=6)
    assert score >= 0.95
    assert min(precision, recall) >= 0.95


@pytest.mark.slow
def test_visible_voxels_agree_with_rays_on_many_meshes():
    """The cluttered ones stay below 0.95: half of what they miss is hidden in part."""
    scores = {name: agreement(name, num_places=6) for name in ("flat", "office", "gallery")}
    print({name: score.round(3).tolist() for name, score in scores.items()})
    assert min(score[0] for score in scores.values()) >= 0.92
    assert np.mean([score[0] for score in scores.values()]) >= 0.95
