"""Options that several commands share: one class, and one box of `--help`, for each group."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import tyro


@dataclass(frozen=True, kw_only=True)
class FolderOptions:
    """Where a run is kept."""

    TITLE: ClassVar[str] = "folder"

    name: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Name of the folder; by default made of the scene, who chooses the views, and the seed."""

    out: Path = Path("runs")
    """Folder that holds it."""

    overwrite: bool = False
    """Replace what has that name, if there is one."""


@dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """How a scene is opened."""

    TITLE: ClassVar[str] = "scene"

    start: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y Z")] = None
    """Start position in the z-up world [m]; by default the scene's own, or a search."""

    up: Literal["y", "z"] | None = None
    """Vertical axis of a mesh file; by default y for GLB and glTF, z for the others."""

    scale: float = 1.0
    """Meters in a unit of a mesh file: 0.001 for one in millimeters."""

    cull_backfaces: bool = False
    """Look through faces seen from behind, as Habitat-Sim always does."""


@dataclass(frozen=True, kw_only=True)
class DepthOptions:
    """What the depth sensor measures."""

    TITLE: ClassVar[str] = "depth sensor"

    noise: float = 0.01
    """Standard deviation of the depth noise as a share of the depth."""

    max_range: float = 5.0
    """Range of the depth sensor [m]."""


@dataclass(frozen=True, kw_only=True)
class MapOptions:
    """What the map is made of."""

    TITLE: ClassVar[str] = "map"

    voxel_size: float = 0.05
    """Edge of a voxel of the map [m]."""

    cell_size: float = 0.2
    """Edge of a cell of the coarse grid [m]."""

    capacity: Annotated[int, tyro.conf.arg(metavar="ROWS")] = 1 << 17
    """Rows of the map at the start, a power of two; a map that may grow has 16384 at least."""


@dataclass(frozen=True, kw_only=True)
class RepeatOptions:
    """What makes a run repeatable."""

    TITLE: ClassVar[str] = "repeatability"

    seed: int = 0
    """All randomness follows from it."""

    clock: Literal["wall", "model"] = "wall"
    """`wall`: measured planning and mapping, plus flight. `model`: fixed costs, repeatable."""
