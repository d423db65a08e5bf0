"""Small worlds made by hand, whose pictures can be worked out on paper."""

from collections.abc import Sequence

import numpy as np

from r3jax.geometry.cameras import Camera
from r3jax.simulators.world import Material, World

SMALL = Camera.from_fov(64, 64, 60.0)

Quad = tuple[Sequence[float], Sequence[float], Sequence[float]]
"""A corner and the two edges from it; the front is where edge 1 x edge 2 points."""


def box_quads(low: Sequence[float], high: Sequence[float], *, inward: bool) -> list[Quad]:
    """The six sides of a box, seen from within or from without."""
    low, size = np.asarray(low, float), np.asarray(high, float) - np.asarray(low, float)
    quads: list[Quad] = []
    for axis in range(3):
        u, v = np.zeros(3), np.zeros(3)
        u[(axis + 1) % 3], v[(axis + 2) % 3] = size[(axis + 1) % 3], size[(axis + 2) % 3]
        far = low.copy()
        far[axis] += size[axis]
        near_pair, far_pair = ((u, v), (v, u)) if inward else ((v, u), (u, v))
        quads += [(low, *near_pair), (far, *far_pair)]
    return quads


def world_of(
    quads: Sequence[Quad],
    materials: Sequence[Material] = (Material(),),
    face_material: Sequence[int] | None = None,
    **fields,
) -> World:
    """A world of quads, two triangles each, with u along edge 1 and v along edge 2."""
    vertices, faces, uv = [], [], []
    for k, (corner, edge1, edge2) in enumerate(quads):
        corner, edge1, edge2 = (np.asarray(x, float) for x in (corner, edge1, edge2))
        vertices += [corner, corner + edge1, corner + edge1 + edge2, corner + edge2]
        faces += [[4 * k, 4 * k + 1, 4 * k + 2], [4 * k, 4 * k + 2, 4 * k + 3]]
        uv += [[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]]
    which = [0] * len(quads) if face_material is None else face_material
    return World(
        name="test",
        vertices=np.array(vertices),
        faces=np.array(faces, np.int32),
        materials=tuple(materials),
        face_material=np.repeat(np.array(which, np.int32), 2),
        face_uv=np.array(uv, np.float32),
        **fields,
    )


def box_room(**fields) -> World:
    """A room of 6 x 4 x 3 m with its lower corner at the origin, seen from within."""
    return world_of(box_quads((0, 0, 0), (6, 4, 3), inward=True), **fields)


def facing_x(x: float, y: float, z: float) -> np.ndarray:
    """The pose at (x, y, z) that looks along +x."""
    pose = np.eye(4)
    pose[:3, :3] = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    pose[:3, 3] = x, y, z
    return pose
