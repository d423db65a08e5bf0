"""Groups of options that several commands share, and what several of them refuse.

Nothing here imports JAX: `--help` and mistyped options must not wait for it.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import arg

from r3jax.apps.benchmark.terms import check_size
from r3jax.cli.parsing import flat
from r3jax.errors import InputError
from r3jax.formats.errors import check_capture
from r3jax.formats.ros.bags import parse_topics
from r3jax.planning.policies import check_policy


@dataclass(frozen=True, kw_only=True)
class FolderOptions:
    """Where the run is stored."""

    name: Annotated[str | None, arg(metavar="NAME")] = None
    """Name of the run's folder; by default made from the scene, the policy and the seed."""

    out: Path = Path("runs")
    """Folder that contains the run's folder."""

    overwrite: bool = False
    """Overwrite an existing run of that name."""

    def __post_init__(self) -> None:
        """Refuses a path as a name."""
        if self.name is not None:
            check_folder_name(self.name)


@dataclass(frozen=True, kw_only=True)
class MeshOptions:
    """How mesh files are opened."""

    up: Literal["y", "z"] | None = None
    """Vertical axis of a mesh file; by default y for GLB and glTF, z for other formats."""

    scale: float = 1.0
    """Unit of a mesh file [m]: 0.001 for millimeters."""

    cull_backfaces: bool = False
    """Do not render back faces, like Habitat-Sim."""


@dataclass(frozen=True, kw_only=True)
class WorldOptions(MeshOptions):
    """How a scene is opened."""

    start: Annotated[tuple[float, float, float] | None, arg(metavar="X Y Z")] = None
    """Start position in the z-up world [m]; by default the scene's own, or found by a search."""


@dataclass(frozen=True, kw_only=True)
class CameraOptions:
    """The simulated camera."""

    resolution: int = 512
    """Width and height of the images [px]."""

    fov: float = 60.0
    """Field of view [degrees]."""

    noise: float = 0.01
    """Standard deviation of the depth noise, relative to the depth."""

    def __post_init__(self) -> None:
        """Refuses image sizes that no run takes."""
        check_size("resolution", self.resolution)


@dataclass(frozen=True, kw_only=True)
class ReadingOptions:
    """How splats are rendered, and how a recording is read."""

    backend: Literal["auto", "numba", "xla", "splax"] = "auto"
    """Rasterizer: numba on CPUs, splax on NVIDIA GPUs if installed, xla elsewhere."""

    up: Literal["y", "z"] = "y"
    """Vertical axis of a recording's world."""

    seed: int = 0
    """Random seed."""

    topics: Annotated[str | None, arg(metavar="NAMES")] = None
    """Topics and frames of a ROS bag, such as color=/cam/image_raw,pose=/odom; also depth, info,
    depth_info, frame, world. By default they are detected."""

    def __post_init__(self) -> None:
        """Refuses topics that cannot be parsed."""
        parse_topics(self.topics)


def refuse_others(options: Any, flag: str, source: str, allowed: tuple[str, ...]) -> None:
    """Refuses options that another option makes irrelevant.

    Args:
        options: of a command.
        flag: the option that decides the others.
        source: where their values come from instead.
        allowed: options that make sense beside it.

    Raises:
        ValueError: names the options to leave out.
    """
    given = [field.name for field, value in flat(options) if value != field.default]
    names = ", ".join(f"--{name.replace('_', '-')}" for name in given if name not in allowed)
    if names:
        raise InputError(f"{flag} takes these from the {source}, leave them out: {names}")


def check_policy_here(name: str) -> None:
    """Refuses an unknown policy; classes are also looked up in the current folder.

    Raises:
        ValueError: as `check_policy`.
    """
    here = str(Path.cwd())
    if ":" in name and here not in sys.path:
        sys.path.insert(0, here)
    check_policy(name)


def check_scene(name: str, scale: float) -> None:
    """Refuses an unknown scene.

    Raises:
        ValueError: names the known ones, or the file.
    """
    from r3jax.simulators.scenes import names  # imports NumPy, which `--help` can do without

    names.check_scene(name, scale)


def check_folder_name(name: str) -> None:
    """Refuses a --name that is a path out of its folder.

    Raises:
        ValueError: the name is a path.
    """
    if Path(name).name != name or name == "..":
        raise InputError(f"--name is the name of one folder, without a path, got {name!r}")


def check_run(path: Path) -> None:
    """Refuses a path that is not a run's folder.

    Raises:
        ValueError: names the folder.
    """
    if not path.is_dir():
        what = "this is a file; a run is a folder" if path.exists() else "there is no such folder"
        raise InputError(f"{path}: {what}")
    if not (path / "run.json").exists():
        raise InputError(f"{path}: this folder is not a run (it has no run.json)")


def check_free(folder: Path, overwrite: bool) -> None:
    """Refuses a folder that contains a run, unless it may be overwritten.

    Raises:
        ValueError: names the folder.
    """
    if (folder / "run.json").exists() and not overwrite:
        raise InputError(
            f"{folder}: the run exists already: choose another name or give --overwrite"
        )


def check_folder(path: Path) -> None:
    """Refuses a file in place of a folder, and a name that no folder can have.

    Raises:
        ValueError: names the path.
    """
    if "\0" in str(path):
        raise InputError("--out: this cannot be the name of a folder")
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: this is a file, --out is a folder")


def check_model(path: Path, name: str, resolution: int | None) -> None:
    """Refuses a path, a name or an image size that neither training nor evaluation takes.

    Raises:
        ValueError: names the option or the path.
    """
    check_folder_name(name)
    check_size("resolution", resolution, most=None)
    check_capture(path)
