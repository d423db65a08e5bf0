"""Scenes by name: the embedded rooms, and any mesh file as `mesh:<file>`."""

import numpy as np

from r3jax.geometry.cameras import Camera
from r3jax.scenes import procedural
from r3jax.simulators.base import Simulator
from r3jax.simulators.meshes import load_world
from r3jax.simulators.noise import NoisySimulator
from r3jax.simulators.raycast import RaycastSimulator
from r3jax.simulators.world import World

_MESH_PREFIX = "mesh:"


def scene_names() -> list[str]:
    """Names of the embedded scenes. `mesh:<file>` opens any mesh besides."""
    return list(procedural.names())


def describe(name: str) -> str:
    """One line about a scene.

    Raises:
        ValueError: the scene is unknown; the message lists the known ones.
    """
    if name.startswith(_MESH_PREFIX):
        return f"the mesh file {name.removeprefix(_MESH_PREFIX)}"
    _check_known(name)
    return procedural.describe(name)


def open_world(spec: str, up: str | None = None) -> World:
    """The triangles and materials behind a scene's name.

    Args:
        spec: the name of an embedded scene, or `mesh:<file>`.
        up: vertical axis of a mesh file, "y" or "z"; None: y for glTF, z for everything else.

    Raises:
        ValueError: the scene is unknown, `up` is given for an embedded scene, or the mesh file is
            refused (see `load_world`).
    """
    if spec.startswith(_MESH_PREFIX):
        file = spec.removeprefix(_MESH_PREFIX)
        if not file:
            raise ValueError("mesh: needs a file after the colon, for example mesh:house.glb")
        return load_world(file, up)
    _check_known(spec)
    if up not in (None, "z"):
        raise ValueError(f"up={up!r} is for mesh files; the embedded scene {spec!r} is z-up")
    return procedural.build(spec)


def open_scene(
    spec: str,
    *,
    up: str | None = None,
    camera: Camera | None = None,
    noise: float | int = 0.01,
    seed: int = 0,
    max_range: float | int | None = 5.0,
    start_pose: np.ndarray | None = None,
) -> Simulator:
    """Opens a scene for exploration.

    Args:
        spec: the name of an embedded scene, or `mesh:<file>`.
        up: vertical axis of a mesh file, "y" or "z"; None: y for glTF, z for everything else.
        camera: intrinsics; None: 512x512 pixels, 60 degrees.
        noise: standard deviation of the depth as a share of the depth; 0: exact depth.
        seed: of the noise, and of the search for a start where the scene has none.
        max_range: reach of the depth sensor [m]; None: unlimited.
        start_pose: `T_world_camera` at the start; None: the scene's own, or a search.

    Raises:
        ValueError: see `open_world` and `RaycastSimulator`.
    """
    simulator = RaycastSimulator(
        open_world(spec, up), camera, max_range=max_range, start_pose=start_pose, seed=seed
    )
    return NoisySimulator(simulator, noise, seed) if noise != 0.0 else simulator


def scene_hash(simulator: Simulator) -> str:
    """SHA-256 of what a simulator from `open_scene` shows: geometry, colours, lamps.

    Raises:
        ValueError: the simulator does not come from `open_scene`.
    """
    inner = simulator.simulator if isinstance(simulator, NoisySimulator) else simulator
    if not isinstance(inner, RaycastSimulator):
        raise ValueError(f"a {type(inner).__name__} has no world that could be hashed")
    return inner.world.content_hash


def _check_known(name: str) -> None:
    if name not in procedural.names():
        raise ValueError(
            f"unknown scene {name!r}; known are {', '.join(procedural.names())}, and "
            "mesh:<file> for any GLB, glTF, PLY or OBJ file"
        )
