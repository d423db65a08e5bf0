"""From a model to a world: materials numbered, triangles stacked, corners darkened.

The ray caster's lamps throw no shadows, so what makes things stand *on* a floor is baked here:
ambient occlusion per triangle corner, from a blurred voxel image of the whole scene.

Shape symbols: F triangles; X Y Z voxels.
"""

import math

import numpy as np
from scipy import ndimage

from r3jax.simulators.scenes.procedural.materials.random_fields import Real
from r3jax.simulators.scenes.procedural.model import Finish, Model
from r3jax.simulators.world import Lamp, Material, World

_VOXEL = 0.1  # [m]


def assemble(
    name: str,
    model: Model,
    start: tuple[Real, Real, Real],
    yaw_deg: Real,
    description: str,
    ambient: Real = 0.78,
) -> World:
    """The world of a furnished model.

    Args:
        name: the scene's name.
        model: walls, furniture and lamps.
        start: camera center at the start [m].
        yaw_deg: its heading from the x axis [deg].
        description: one sentence for lists.
        ambient: share of the color that shows without lamps.
    """
    numbers: dict[int, int] = {}
    materials: list[Material] = []

    def number(finish: Finish) -> int:
        if id(finish) not in numbers:
            numbers[id(finish)] = len(materials)
            materials.append(finish.material)
        return numbers[id(finish)]

    counts = [len(p.corners) for p in model.pieces]
    corners = np.concatenate([p.corners for p in model.pieces])
    face_material = np.repeat([number(p.finish) for p in model.pieces], counts)
    uv = np.concatenate([p.uv for p in model.pieces])
    tint = np.repeat(np.array([p.tint for p in model.pieces]), counts, axis=0)
    light = ambient_occlusion(corners)
    glows = np.array([m.emission for m in materials])[face_material]
    light = np.maximum(light, glows[:, None])
    face_color = np.clip(tint[:, None, :] * light[..., None], 0.0, 1.0)
    # Vertices are rounded to 1 um: the same bytes whatever order the sums were made in.
    vertices = np.round(corners.reshape(-1, 3), 6)
    return World(
        name=name,
        vertices=vertices,
        faces=np.arange(len(vertices), dtype=np.int32).reshape(-1, 3),
        materials=tuple(materials),
        face_material=face_material.astype(np.int32),
        face_uv=uv.astype(np.float32),
        face_color=np.round(face_color, 3).astype(np.float32),
        lamps=_rounded(model.lamps),
        ambient=ambient,
        start_position=np.array(start, dtype=np.float64),
        start_yaw=math.radians(yaw_deg),
        notes={"source": "r3jax.simulators.scenes.procedural", "description": description},
    )


def _rounded(lamps: list[Lamp]) -> tuple[Lamp, ...]:
    out: list[Lamp] = []
    for lamp in lamps:
        x, y, z = (round(c, 6) for c in lamp.position)
        out.append(Lamp((x, y, z), lamp.color, lamp.reach))
    return tuple(out)


def ambient_occlusion(corners: np.ndarray) -> np.ndarray:
    """How much of the surroundings each corner sees, roughly.

    The scene's surfaces are splatted into voxels and blurred at two scales; a corner looks up
    the density a little in front of its face.

    Args:
        corners: [F, 3, 3] [m].

    Returns:
        [F, 3], from 0.4 (deep in a corner) to 1 (open).
    """
    origin = corners.min(axis=(0, 1)) - 3 * _VOXEL
    size = np.ceil((corners.max(axis=(0, 1)) - origin) / _VOXEL).astype(int) + 4
    filled = _splat(corners, origin, size)
    edge_a, edge_b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(edge_a, edge_b)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    middle = corners.mean(axis=1, keepdims=True)
    light = np.ones(corners.shape[:2])
    # A lone wall fills `open_share` of the blurred ball in front of it; more is occlusion.
    for sigma, offset, open_share, strength in ((1.2, 0.12, 0.24, 0.28), (3.5, 0.3, 0.15, 0.6)):
        density = ndimage.gaussian_filter(filled, sigma, mode="nearest")
        inward = 0.9 * corners + 0.1 * middle
        at = (inward + offset * normal[:, None] - origin) / _VOXEL - 0.5
        here = ndimage.map_coordinates(density, at.reshape(-1, 3).T, order=1, mode="nearest")
        excess = np.maximum(here.reshape(light.shape) - open_share, 0.0)
        light *= np.exp(-strength * excess / 0.25)
    return np.clip(light, 0.4, 1.0)


def _splat(corners: np.ndarray, origin: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Voxels that any surface touches, [X, Y, Z] float32 of 0 and 1."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.linalg.norm(normal, axis=1)
    counts = np.ceil(4.0 * area / _VOXEL**2).astype(int)
    face = np.repeat(np.arange(len(corners)), counts)
    k = np.arange(len(face)) - np.repeat(np.cumsum(counts) - counts, counts)
    # The R2 sequence spreads the points of each triangle evenly; fold the square in two.
    a, b = (0.5 + 0.7548776662466927 * k) % 1.0, (0.5 + 0.5698402909980532 * k) % 1.0
    outside = a + b > 1.0
    a, b = np.where(outside, 1.0 - a, a), np.where(outside, 1.0 - b, b)
    scaled = ((corners - origin) / _VOXEL).astype(np.float32)
    start, edges = scaled[:, 0], scaled[:, 1:] - scaled[:, :1]
    points = start[face] + a[:, None] * edges[face, 0] + b[:, None] * edges[face, 1]
    index = points.astype(int)
    filled = np.zeros(tuple(size), dtype=np.float32)
    filled[index[:, 0], index[:, 1], index[:, 2]] = 1.0
    return filled
