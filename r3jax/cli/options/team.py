"""The options of the command that explores with several cameras."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class Team:
    """Explore a scene with several cameras at once that tell each other what they saw."""

    scene: Annotated[str | None, tyro.conf.arg(metavar="SCENE")] = None
    """Embedded scene by name, or `mesh:<file>` (GLB, PLY, OBJ); `r3jax info` lists them."""

    cameras: int = 2
    """How many fly at the same time."""

    policy: tuple[str, ...] = ("ours-pano",)
    """Who chooses each camera's views; one for all, or one for each."""

    fov: tuple[float, ...] = (60.0,)
    """Fields of view [degrees]; one for all, or one for each."""

    resolution: tuple[int, ...] = (512,)
    """Widths and heights of the images [px]; one for all, or one for each."""

    budget: Annotated[str | None, tyro.conf.arg(metavar="BUDGET")] = None
    """When each camera stops: `seconds:S` of its mission clock (120 by default), `views:N`,
    `metres:M`."""

    meet_every: float = 0.0
    """Seconds of the mission clock between two meetings; 0: they are always in touch."""

    resume: Annotated[Path | None, tyro.conf.arg(metavar="TEAM")] = None
    """Go on with a team that was cut off; all settings are its own. Another --budget extends it."""

    name: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Name of the team's folder; by default made of scene, cameras and seed."""

    out: Path = Path("runs")
    """Folder that holds it; the cameras' runs are the folders 0, 1, ... in it."""

    overwrite: bool = False
    """Replace the team of that name if there is one."""

    seed: int = 0
    """All randomness follows from it."""

    clock: Literal["wall", "model"] = "wall"
    """`wall`: measured planning and mapping + flight. `model`: fixed costs, repeatable."""

    up: Literal["y", "z"] | None = None
    """Vertical axis of a mesh file; by default y for GLB and glTF, z for the others."""

    scale: float = 1.0
    """Metres in a unit of a mesh file: 0.001 for one in millimeters."""

    cull_backfaces: bool = False
    """Look through faces seen from behind, as Habitat-Sim always does."""

    noise: float = 0.01
    """Standard deviation of the depth noise as a share of the depth."""

    max_range: float = 5.0
    """Range of the depth sensors [m]."""

    start: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y Z")] = None
    """Start position of the first camera in the z-up world [m]; the others start beside it."""

    voxel_size: float = 0.05
    """Edge of a voxel of the map [m]."""

    cell_size: float = 0.2
    """Edge of a cell of the coarse grid [m]."""

    capacity: Annotated[int, tyro.conf.arg(metavar="ROWS")] = 1 << 17
    """Rows of the map at the start, a power of two; a map that may grow has 16384 at least."""

    candidates: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Candidates per decision (policy's default: 100)."""
