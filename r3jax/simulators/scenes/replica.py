"""The Replica dataset (Straub et al., arXiv 1906.05797): the nine scenes that the paper uses.

R3JAX_REPLICA_ROOT names the folder that the dataset was unpacked into:

    <root>/office_0/mesh.ply                                      quads with vertex colors
    <root>/office_0/habitat/replicaSDK_stage.stage_config.json    what Habitat-Sim loads

The ray caster shows the vertex colors. The paper names no places to start from: the start is
searched for in the mesh, the same one for the same seed, in the ray caster and in Habitat.
"""

import os
from pathlib import Path

from r3jax.errors import InputError

ROOT = "R3JAX_REPLICA_ROOT"
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
    f"download.sh <folder>, then `export {ROOT}=<folder>` (the folder that holds office_0, room_0 "
    "and the others)"
)


def names() -> list[str]:
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
    root = os.environ.get(ROOT)
    if not root:
        raise InputError(f"Replica scenes need the variable {ROOT}; {_HOW_TO_GET}")
    return Path(root).expanduser() / _FOLDERS[name]
