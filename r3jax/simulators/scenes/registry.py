"""Scenes by name: the embedded rooms, any mesh file, Replica's scenes, and Habitat-Sim."""

import dataclasses

import numpy as np

from r3jax.errors import InputError
from r3jax.extras import naming_extras
from r3jax.geometry.cameras import Camera
from r3jax.kernels.native.ahead import compile_ahead
from r3jax.kernels.native.platform import is_cpu_only, missing_for_machine_code
from r3jax.simulators.base import NoisySimulator, Simulator
from r3jax.simulators.habitat import HabitatSimulator, read_stage
from r3jax.simulators.meshes import load_world
from r3jax.simulators.raycast.raycast import RaycastSimulator
from r3jax.simulators.scenes import names, procedural
from r3jax.simulators.scenes.names import (
    OUTSIDE,
    check_scale,
    habitat_file,
    outside_scenes,
    split_name,
)
from r3jax.simulators.world import World

__all__ = ["describe", "open_scene", "open_world", "outside_scenes", "scene_hash", "scene_names"]


def scene_names() -> list[str]:
    """Lists the embedded scenes; `outside_scenes` lists other kinds."""
    return list(procedural.names())


def describe(name: str) -> str:
    """Describes a scene in one line.

    Raises:
        ValueError: the scene is unknown; the message lists the known ones.
    """
    kind, rest = split_name(name)
    return f"{OUTSIDE[kind][0]} {rest}" if kind in OUTSIDE else procedural.describe(name)


@naming_extras()
def open_world(spec: str, up: str | None = None, scale: float | int = 1.0) -> World:
    """Opens the triangles and materials behind a scene's name.

    Args:
        spec: the name of an embedded scene, or one of `outside_scenes`. For a Habitat scene this is
            its mesh.
        up: vertical axis of a mesh file, "y" or "z"; None: y for glTF, z for everything else.
        scale: unit of a mesh file [m].

    Raises:
        ValueError: the scene is unknown, `up` or `scale` is given for a scene that is no mesh
            file, or the mesh file is refused (see `load_world`) or missing.
    """
    kind, rest = split_name(spec)
    if kind == "mesh":
        return load_world(rest, up, scale)
    check_scale(spec, scale)
    if kind == "habitat":
        return load_world(read_stage(habitat_file(rest)).mesh, up)
    if up not in (None, "z"):
        raise InputError(f"up={up!r} is for mesh files; the scene {spec!r} is z-up")
    if kind == "replica":
        return dataclasses.replace(load_world(names.mesh_file(rest)), name=spec)
    return procedural.build(spec)


@naming_extras()
def open_scene(
    spec: str,
    *,
    up: str | None = None,
    scale: float | int = 1.0,
    cull_back_faces: bool = False,
    camera: Camera | None = None,
    noise: float | int = 0.01,
    seed: int = 0,
    max_range: float | int | None = 5.0,
    start_pose: np.ndarray | None = None,
) -> Simulator:
    """Opens a scene for exploration.

    The first one on a machine also starts a process that compiles the CPU kernels.

    Args:
        spec: the name of an embedded scene, or one of `outside_scenes`.
        up: vertical axis of a mesh file, "y" or "z"; None: y for glTF, z for everything else.
        scale: unit of a mesh file [m]: 0.001 for millimeters.
        cull_back_faces: do not render back faces, like Habitat.
        camera: intrinsics; None: 512x512 pixels, 60 degrees.
        noise: standard deviation of the depth noise, relative to the depth; 0: exact depth.
        seed: random seed of the noise, and of the search for a start if the scene has none.
        max_range: range of the depth sensor [m]; None: unlimited.
        start_pose: `T_world_camera` at the start; None: the scene's own, or a search.

    Raises:
        ValueError: see `open_world`, `RaycastSimulator` and `HabitatSimulator`.
        ImportError: Numba cannot be used; the extra `sim`, or Habitat-Sim for a Habitat scene, is
            not installed.
    """
    kind, rest = split_name(spec)
    if is_cpu_only():
        compile_ahead()
    simulator: Simulator
    if kind == "habitat":
        check_scale(spec, scale)
        simulator = HabitatSimulator(
            habitat_file(rest),
            camera,
            up=up,
            max_range=max_range,
            start_pose=start_pose,
            seed=seed,
        )
    else:
        if problem := missing_for_machine_code():
            raise ImportError(f"{spec}: scenes are rendered by machine code, but {problem}")
        simulator = RaycastSimulator(
            open_world(spec, up, scale),
            camera,
            max_range=max_range,
            start_pose=start_pose,
            cull_back_faces=cull_back_faces,
            seed=seed,
        )
    return NoisySimulator(simulator, noise, seed) if noise != 0.0 else simulator


def scene_hash(simulator: Simulator) -> str:
    """Computes the SHA-256 of a simulator's content: geometry, colors, lamps, and the renderer.

    Raises:
        ValueError: the simulator does not come from `open_scene`.
    """
    inner = simulator.simulator if isinstance(simulator, NoisySimulator) else simulator
    if not isinstance(inner, HabitatSimulator | RaycastSimulator):
        raise InputError(f"a {type(inner).__name__} has no world that could be hashed")
    return inner.content_hash
