"""A room in a file, for all tests that open a scene as users do."""

import functools
from pathlib import Path

import numpy as np
import trimesh


@functools.cache
def write_room(path: Path) -> str:
    """A box room with a pillar and colors at random, as `mesh:<file>`."""
    walls = trimesh.creation.box(extents=(4.0, 3.0, 2.4))
    walls.invert()
    pillar = trimesh.creation.box(extents=(0.3, 0.3, 2.4))
    pillar.apply_translation((1.2, 0.6, 0.0))
    mesh = trimesh.util.concatenate([walls.subdivide().subdivide(), pillar.subdivide()])
    rng = np.random.default_rng(0)
    mesh.visual.vertex_colors = rng.integers(0, 256, (len(mesh.vertices), 3), dtype=np.uint8)
    mesh.export(path)
    return f"mesh:{path}"
