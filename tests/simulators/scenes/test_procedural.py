"""The nine procedural scenes: fixed, sound, closed, walkable, and rich enough to reconstruct."""

import functools
import os
import subprocess
import sys

import numpy as np
import pytest
import trimesh
from scipy import ndimage
from scipy.spatial import cKDTree
from trimesh.ray.ray_pyembree import RayMeshIntersector

from r3jax.simulators.scenes import procedural
from r3jax.simulators.world import World
from tests.tiers import quick_and_full

NAMES = (
    "flat",
    "kitchen",
    "loft",
    "apartment",
    "office",
    "gallery",
    "corridor",
    "classroom",
    "library",
)
CELL, MARGIN = 0.2, 0.3  # the coarse grid and the robot's radius [m]


class BuiltOnDemand(dict):
    """What a function makes of a name, made once."""

    def __init__(self, build):
        super().__init__()
        self._build = build

    def __missing__(self, name):
        self[name] = self._build(name)
        return self[name]


@pytest.fixture(scope="session")
def worlds() -> dict[str, World]:
    return BuiltOnDemand(procedural.build)


@pytest.fixture(scope="session")
def meshes(worlds) -> dict[str, trimesh.Trimesh]:
    return BuiltOnDemand(
        lambda n: trimesh.Trimesh(worlds[n].vertices, worlds[n].faces, process=False)
    )


@pytest.fixture(params=quick_and_full(NAMES, ["flat"]))
def name(request) -> str:
    return request.param


def corners_and_normals(world: World) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Triangles [F, 3, 3], unit normals [F, 3] and areas [F]."""
    corners = world.vertices[world.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(cross, axis=1)
    return corners, cross / length[:, None], length / 2


def test_there_are_nine_and_their_names_are_fixed():
    assert procedural.names() == (*NAMES, "tower")  # which has tests of its own
    assert all(procedural.describe(n).endswith("m2") for n in NAMES)


def test_an_unknown_name_lists_the_known_ones():
    for call in (procedural.build, procedural.describe, procedural.rooms):
        with pytest.raises(ValueError, match=r"'attic'.*flat"):
            call("attic")


@pytest.mark.full
def test_another_process_builds_the_same_bytes(worlds):
    code = (
        "from r3jax.simulators.scenes import procedural as p; print(p.build('flat').content_hash)"
    )
    env = {**os.environ, "PYTHONHASHSEED": "7"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, env=env, check=True)
    assert done.stdout.decode().strip() == worlds["flat"].content_hash


@pytest.mark.slow
def test_a_second_build_is_equal_and_scenes_differ(worlds):
    assert procedural.build("office").content_hash == worlds["office"].content_hash
    assert len({w.content_hash for w in map(worlds.__getitem__, NAMES)}) == len(NAMES)


def test_the_mesh_is_sound(worlds, name):
    world = worlds[name]
    count = len(world.faces)
    assert 5_000 <= count <= 60_000
    assert np.all(np.isfinite(world.vertices))
    assert world.faces.min() >= 0
    assert world.faces.max() < len(world.vertices)
    assert world.face_uv.shape == (count, 3, 2)
    assert np.all(np.isfinite(world.face_uv))
    assert world.face_material.min() == 0
    assert world.face_material.max() == len(world.materials) - 1
    assert world.face_color is not None
    assert world.face_color.min() >= 0.03
    assert world.face_color.max() <= 1.0
    assert corners_and_normals(world)[2].min() > 1e-10


def test_textures_fit_in_memory_and_cannot_be_written(worlds, name):
    textures = [m.texture for m in worlds[name].materials]
    assert all(t.dtype == np.uint8 and not t.flags.writeable for t in textures)
    assert sum(t.nbytes for t in textures) < 150e6
    assert max(max(t.shape) for t in textures) <= 1024


def test_sizes_are_those_of_homes_and_offices(worlds, name):
    rectangles = np.array(list(procedural.rooms(name).values()))
    area = np.prod(rectangles[:, 2:] - rectangles[:, :2], axis=1).sum()
    assert 15.0 <= area <= 120.0
    assert 2.4 <= worlds[name].bounds[1, 2] - 0.25 <= 3.0


def test_walls_face_their_room_and_are_thick(worlds, name):
    world = worlds[name]
    corners, normals, _ = corners_and_normals(world)
    rectangles = np.array(list(procedural.rooms(name).values()))
    for x0, y0, x1, y1 in rectangles:
        middle = corners.mean(axis=1)
        within = (middle > [x0 - 1e-6, y0 - 1e-6, 0]) & (middle < [x1 + 1e-6, y1 + 1e-6, 9])
        for axis, value, inward in ((0, x0, 1), (0, x1, -1), (1, y0, 1), (1, y1, -1)):
            on_wall = within.all(axis=1) & (np.ptp(corners[:, :, axis], axis=1) < 1e-9)
            on_wall &= np.abs(middle[:, axis] - value) < 1e-9
            facing = normals[on_wall, axis] * inward
            # Backs of furniture may touch a wall; the wall itself faces the room.
            assert np.sum(facing > 0.99) >= 40
    gaps = [
        max(b[0] - a[2], a[0] - b[2], b[1] - a[3], a[1] - b[3])
        for i, a in enumerate(rectangles)
        for b in rectangles[i + 1 :]
    ]
    assert min(gaps, default=1.0) >= 0.099
    low, high = world.bounds[:, :2]
    assert np.all(rectangles[:, :2].min(axis=0) - low >= 0.2)
    assert np.all(high - rectangles[:, 2:].max(axis=0) >= 0.2)


@pytest.fixture(scope="session")
def views(worlds, meshes):
    """`views(name)`: length and face of rays in all directions from the start and each room."""

    @functools.cache
    def look(name: str) -> tuple[np.ndarray, np.ndarray]:
        direction = np.random.default_rng(0).normal(size=(3000, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        rooms = procedural.rooms(name).values()
        centers = [((x0 + x1) / 2, (y0 + y1) / 2, 1.3) for x0, y0, x1, y1 in rooms]
        eyes = np.array([worlds[name].start_position, *centers])
        start = eyes[np.arange(len(direction)) % len(eyes)]
        caster = RayMeshIntersector(meshes[name])
        points, ray, face = caster.intersects_location(start, direction, multiple_hits=False)
        length = np.full(len(direction), np.inf)
        length[ray] = np.linalg.norm(points - start[ray], axis=1)
        return length, face

    return look


def on_shell(world: World) -> np.ndarray:
    """True for the triangles of the outer shell, [F]."""
    away = np.abs(world.vertices[world.faces][:, :, None] - world.bounds)
    return (away < 1e-6).all(axis=1).any(axis=(1, 2))


def test_nobody_sees_outside(worlds, views, name):
    length, face = views(name)
    assert np.mean(length < 30.0) >= 0.995
    # The outer shell is there so that nothing leaks, not to be seen.
    assert np.mean(on_shell(worlds[name])[face]) <= 0.002


def surface_points(mesh: trimesh.Trimesh) -> np.ndarray:
    points, _ = trimesh.sample.sample_surface(mesh, 250_000, seed=0)
    return np.concatenate([points, mesh.vertices])


def test_the_start_is_free_and_every_room_can_be_reached(worlds, meshes, name):
    world, rooms = worlds[name], procedural.rooms(name)
    tree = cKDTree(surface_points(meshes[name]))
    assert tree.query(world.start_position)[0] >= 0.6
    assert world.start_position[2] == 1.3

    low, high = world.bounds
    x, y = (np.arange(low[k] + CELL / 2, high[k], CELL) for k in (0, 1))
    xy = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    at = np.concatenate([xy, np.full((*xy.shape[:2], 1), 1.3)], axis=-1)
    clearance = tree.query(at.reshape(-1, 3))[0].reshape(xy.shape[:2])
    region, _ = ndimage.label(clearance > MARGIN)
    cell = lambda px, py: region[int((px - low[0]) / CELL), int((py - low[1]) / CELL)]
    home = cell(*world.start_position[:2])
    assert home > 0
    for key, (x0, y0, x1, y1) in rooms.items():
        assert cell((x0 + x1) / 2, (y0 + y1) / 2) == home, f"{key}: its middle cannot be reached"
        inside = (xy > [x0, y0]).all(axis=-1) & (xy < [x1, y1]).all(axis=-1)
        assert np.mean(region[inside] == home) >= 0.25, f"{key}: hardly any room to move"


def test_texels_are_even_where_one_looks(worlds, views, name):
    world = worlds[name]
    area = corners_and_normals(world)[2]
    size = np.array([m.texture.shape[:2] for m in world.materials])[world.face_material]
    uv = world.face_uv.astype(np.float64)
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    in_texels = 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) * size[:, 0] * size[:, 1]
    seen = np.sqrt(in_texels / area)[views(name)[1]]
    assert np.mean(seen > 150) >= 0.97
    assert np.mean((seen > 180) & (seen < 700)) >= 0.85


@pytest.mark.full
def test_materials_depend_on_the_view_and_defeat_the_sensor(worlds):
    has = lambda test: sum(
        any(test(m) for m in w.materials) for w in map(worlds.__getitem__, NAMES)
    )
    assert has(lambda m: m.specular >= 0.3) == 9
    assert has(lambda m: m.is_hole and m.emission > 0.5) == 9  # windows
    assert has(lambda m: m.mirror >= 0.8) >= 6
    assert has(lambda m: 0.02 <= m.mirror <= 0.2) == 9  # glossy floors and worktops
    assert any(m.is_hole and m.mirror > 0.3 for m in worlds["office"].materials)  # glass walls
    assert all(len(w.lamps) >= 3 for w in map(worlds.__getitem__, NAMES))


def test_every_surface_has_detail_at_several_scales(worlds, name):
    """Contrast between neighbors after shrinking by 1, 4 and 16, on nearly all of the area."""
    world = worlds[name]
    _, _, area = corners_and_normals(world)
    weight = np.bincount(world.face_material, weights=area, minlength=len(world.materials))
    contrast = []
    for material in world.materials:
        gray = material.texture.astype(np.float32).mean(axis=2)
        levels = []
        for block in (1, 4, 16):
            h, w = (n // block * block for n in gray.shape)
            small = gray[:h, :w].reshape(h // block, block, w // block, block).mean(axis=(1, 3))
            levels.append(
                np.abs(np.diff(small, axis=1)).mean() + np.abs(np.diff(small, axis=0)).mean()
            )
        contrast.append(levels)
    enough = (np.array(contrast) > [2.0, 2.0, 1.5]).all(axis=1)
    assert weight[enough].sum() / weight.sum() >= 0.9
