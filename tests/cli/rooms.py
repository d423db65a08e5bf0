"""A room in a file and small runs in it, for the tests of the command line."""

from pathlib import Path

import numpy as np
import trimesh

from r3jax.cli.main import main


def write_room(folder: Path) -> str:
    """A box room with a pillar, as `mesh:<file>`."""
    walls = trimesh.creation.box(extents=(4.0, 3.0, 2.4))
    walls.invert()
    pillar = trimesh.creation.box(extents=(0.3, 0.3, 2.4))
    pillar.apply_translation((1.2, 0.6, 0.0))
    mesh = trimesh.util.concatenate([walls.subdivide().subdivide(), pillar.subdivide()])
    rng = np.random.default_rng(0)
    mesh.visual.vertex_colors = rng.integers(0, 256, (len(mesh.vertices), 3), dtype=np.uint8)
    path = folder / "room.ply"
    mesh.export(path)
    return f"mesh:{path}"


def explore(room: str, out: Path, *words: str) -> int:
    """A small run; the same shapes everywhere, so that each part compiles once."""
    options = {"scene": room, "policy": "random", "budget": "views:3", "clock": "model"}
    options |= {"resolution": 48, "fov": 90, "capacity": 16384, "voxel-size": 0.1}
    options |= {"out": out, "name": "box", "candidates": 20}
    given = [word for name, value in options.items() for word in (f"--{name}", str(value))]
    return main(["explore", *given, *words])
