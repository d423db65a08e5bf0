"""The tower: closed, and every room of every story can be reached by a camera that flies."""

import numpy as np
import pytest
import trimesh
from scipy import ndimage
from trimesh.ray.ray_pyembree import RayMeshIntersector

from r3jax.simulators.scenes import procedural
from r3jax.simulators.scenes.procedural.catalog import tower
from r3jax.simulators.scenes.procedural.model import surface_voxels
from tests.simulators.scenes.test_procedural import on_shell

EYES, MARGIN = 1.3, 0.3
"""Height above the floor, and radius of the camera [m]."""

VOXEL = 0.1

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def world():
    return procedural.build("tower")


@pytest.fixture(scope="module")
def rooms():
    return tower.plan().rooms


def eyes_of(rooms):
    return np.array([[*room.center, room.base + EYES] for room in rooms.values()])


def test_three_stories_of_sixty_meters(world, rooms):
    low, high = world.bounds
    np.testing.assert_allclose((high - low)[:2], 60.5)
    assert 9.0 < (high - low)[2] < 11.0
    assert len({room.base for room in rooms.values()}) == tower.STORIES == 3
    area = sum((r.x1 - r.x0) * (r.y1 - r.y0) for r in rooms.values())
    assert area == pytest.approx(9900.0, rel=0.01)
    # What a person's computer holds.
    assert len(world.faces) < 1_500_000
    assert sum(m.texture.nbytes for m in world.materials) < 150e6


def test_nobody_sees_outside(world, rooms):
    mesh = trimesh.Trimesh(world.vertices, world.faces, process=False)
    direction = np.random.default_rng(0).normal(size=(20_000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    eyes = eyes_of(rooms)
    start = eyes[np.arange(len(direction)) % len(eyes)]
    _, ray, face = RayMeshIntersector(mesh).intersects_location(
        start, direction, multiple_hits=False
    )
    assert len(np.unique(ray)) >= 0.999 * len(direction)
    assert np.mean(on_shell(world)[face]) <= 0.001


def test_the_start_is_free_and_every_room_can_be_reached(world, rooms):
    low = world.bounds[0] - 3 * VOXEL
    filled = surface_voxels(world.vertices[world.faces], low, VOXEL)
    free = ndimage.distance_transform_edt(~filled, sampling=VOXEL) > MARGIN + VOXEL
    region, _ = ndimage.label(free)
    cell = lambda point: tuple(np.floor((np.asarray(point) - low) / VOXEL).astype(int))
    home = region[cell(world.start_position)]
    assert home > 0
    for name, room in rooms.items():
        first, last = cell((room.x0, room.y0, room.base)), cell((room.x1, room.y1,
                           room.base + room.height))  # fmt: skip
        inside = region[tuple(map(slice, first, last))]
        assert np.mean(inside == home) >= 0.25, f"{name}: hardly any room to move"
