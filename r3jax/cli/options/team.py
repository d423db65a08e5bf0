"""The options of the command that explores with several cameras."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import tyro

from r3jax.cli.options.groups import (
    DepthOptions,
    FolderOptions,
    MapOptions,
    RepeatOptions,
    SceneOptions,
)


@dataclass(frozen=True)
class TeamOptions(FolderOptions, DepthOptions, SceneOptions, MapOptions, RepeatOptions):
    """Explore a scene with several cameras at once that tell each other what they saw."""

    EXAMPLES: ClassVar[tuple[str, ...]] = (
        "r3jax team --scene office --cameras 3 --budget seconds:120",
        "r3jax team --resume runs/office-team3-seed0 --budget seconds:240",
    )

    scene: Annotated[str | None, tyro.conf.arg(metavar="SCENE")] = None
    """Embedded scene by name (`r3jax info` lists them), `mesh:<file>` (GLB, PLY, OBJ),
    `replica:<name>`, or `habitat:<file>` (GLB, PLY, stage config)."""

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
    `meters:M`."""

    meet_every: float = 0.0
    """Seconds of the mission clock between two meetings; 0: they are always in touch."""

    resume: Annotated[Path | None, tyro.conf.arg(metavar="TEAM")] = None
    """Go on with a team that was cut off; all settings are its own. Another --budget extends it."""

    candidates: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Candidates per decision (policy's default: 100)."""
