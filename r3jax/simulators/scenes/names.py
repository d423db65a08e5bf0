"""Names of scenes, checked without opening them, and where files of the Replica dataset lie.

R3JAX_REPLICA_ROOT names the folder that the dataset (Straub et al., arXiv 1906.05797) was unpacked
into, nine scenes of which the paper uses:

    <root>/office_0/mesh.ply                                      quads with vertex colors
    <root>/office_0/habitat/replicaSDK_stage.stage_config.json    what Habitat-Sim loads

The ray caster shows the vertex colors. The paper names no places to start from: the start is
searched for in the mesh, the same one for the same seed, in the ray caster and in Habitat.
"""

import os
from pathlib import Path

from r3jax.errors import InputError
from r3jax.simulators.scenes import procedural
from r3jax.validation.errors import did_you_mean

REPLICA_ROOT = "R3JAX_REPLICA_ROOT"
"""Environment variable with the dataset's folder."""

_FOLDERS = {
    f"{kind}{number}": f"{kind}_{number}"
    for kind, count in (("hotel", 1), ("office", 5), ("room", 3))
    for number in range(count)
}
"""The paper's names, and the folders of the dataset."""

_STAGES = ("replicaSDK_stage.stage_config.json", "replica_stage.stage_config.json")
"""The name in the authors' preparation of the data, and in Habitat's own configs for Replica."""

_HOW_TO_GET = (
    "the data comes from https://github.com/facebookresearch/Replica-Dataset: run its "
    f"download.sh <folder>, then `export {REPLICA_ROOT}=<folder>` (the folder that holds "
    "office_0, room_0 and the others)"
)


OUTSIDE = {
    "mesh": ("the mesh file", "a file, as in mesh:house.glb"),
    "replica": ("the Replica scene", "a scene, as in replica:office0"),
    "habitat": ("Habitat-Sim on", "a scene of Replica, or a file, as in habitat:house.glb"),
}
"""What comes before a colon: how a description begins, and what must follow the colon."""

MESH_SUFFIXES = (".glb", ".gltf", ".ply", ".obj")


def outside_scenes() -> dict[str, str]:
    """Lists how to name scenes that are not embedded, each with a line about them."""
    return {
        "mesh:<file>": "any GLB, glTF, PLY or OBJ file",
        "replica:<name>": "hotel0, office0 to office4, room0 to room2 of the Replica dataset; "
        f"{REPLICA_ROOT} names its folder",
        "habitat:<scene>": "Habitat-Sim (conda) on a scene of Replica, or on a .glb, .ply or "
        ".stage_config.json file; vertex colors of a PLY (so Replica's) come out dark in it, they "
        "are the ray caster's instead",
    }


def split_name(spec: str) -> tuple[str, str]:
    """Splits a scene's name into its kind (a key of `OUTSIDE`, or "embedded") and the rest.

    Raises:
        ValueError: the scene is unknown; names the known ones, and the one that was meant.
    """
    kind, colon, rest = spec.partition(":")
    if colon and kind in OUTSIDE:
        if not rest:
            raise InputError(f"{spec} needs {OUTSIDE[kind][1]}")
        return kind, rest
    if spec not in procedural.names():
        if Path(spec).suffix.lower() in MESH_SUFFIXES and not colon:
            hint = f" (did you mean mesh:{spec}?)"
        else:
            outside = [f"{known}:{rest}" for known in OUTSIDE if colon]
            hint = did_you_mean(spec, [*procedural.names(), *outside])
        raise InputError(
            f"unknown scene {spec!r}{hint}; known are {', '.join(procedural.names())}, and "
            f"{', '.join(outside_scenes())}"
        )
    return "embedded", spec


def check_scale(spec: str, scale: float | int) -> None:
    """Refuses a scale for a scene that has its own.

    Raises:
        ValueError: it is not a mesh file.
    """
    kind, _ = split_name(spec)
    if scale == 1.0 or kind == "mesh":
        return
    if kind == "habitat":
        raise InputError(f"scale={scale!r}: Habitat scales nothing, apply it to the mesh file")
    raise InputError(f"scale={scale!r} is for mesh files (mesh:<file>); {spec!r} is in meters")


def check_scene(spec: str, scale: float | int = 1.0) -> None:
    """Refuses a scene that cannot be opened, as far as its name and the disk tell.

    Raises:
        ValueError: the scene is unknown, its file is missing, or it takes no scale.
    """
    check_scale(spec, scale)
    kind, rest = split_name(spec)
    if kind == "mesh" and not Path(rest).is_file():
        raise InputError(f"no such mesh file: {rest} (give a GLB, glTF, PLY or OBJ file)")
    if kind == "replica":
        mesh_file(rest)
    elif kind == "habitat" and not habitat_file(rest).is_file():
        raise InputError(f"no such file for Habitat: {rest}")


def habitat_file(rest: str) -> Path:
    """Finds the file that Habitat loads for the part after `habitat:`.

    Raises:
        ValueError: neither a file nor a scene of Replica; lists these.
    """
    path = Path(rest)
    is_file = bool(path.suffix) or len(path.parts) > 1 or path.exists()
    return path if is_file and rest not in replica_names() else stage_file(rest)


def replica_names() -> list[str]:
    """Lists the nine scenes, as the paper calls them."""
    return list(_FOLDERS)


def mesh_file(name: str) -> Path:
    """Finds the mesh of a scene: z-up, meters.

    Raises:
        ValueError: the scene is unknown, or its file is not there; says how to get it.
    """
    path = _folder(name) / "mesh.ply"
    if not path.is_file():
        raise InputError(f"replica:{name} needs {path}, which is missing; {_HOW_TO_GET}")
    return path


def stage_file(name: str) -> Path:
    """Finds the stage config of a scene, for Habitat-Sim.

    Raises:
        ValueError: the scene is unknown, or its file is not there; says how to get it.
    """
    folder = _folder(name) / "habitat"
    for stage in _STAGES:
        if (folder / stage).is_file():
            return folder / stage
    raise InputError(
        f"habitat:{name} needs {folder / _STAGES[0]}, which is missing (nor is there a "
        f"{_STAGES[1]}); it is one of Habitat's additional configs for Replica, which download.sh "
        f"fetches too; {_HOW_TO_GET}"
    )


def _folder(name: str) -> Path:
    """Returns the folder of a scene; it may be missing."""
    if name not in _FOLDERS:
        raise InputError(f"unknown Replica scene {name!r}; known are {', '.join(_FOLDERS)}")
    root = os.environ.get(REPLICA_ROOT)
    if not root:
        raise InputError(f"Replica scenes need the variable {REPLICA_ROOT}; {_HOW_TO_GET}")
    return Path(root).expanduser() / _FOLDERS[name]
