"""Settings of how a capture is surveyed, options of commands, too. Its import is light."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from r3jax.errors import InputError

Surfaces = Literal["auto", "depth", "sweep", "model", "points"]
"""Where surfaces may come from: see `captures.surfaces`."""


@dataclass(frozen=True)
class SurveySettings:
    """How a capture is read and how fine it is mapped.

    Raises:
        ValueError: a setting that makes no sense; names the option.
    """

    voxel_size: float | None = None
    """Voxel size in the capture's units; by default 5 cm, or from the depths."""

    max_range: float | None = None
    """Surfaces farther from a camera count as invisible, in the capture's units; by default 5 m,
    or from the depths."""

    up: str | None = None
    """Direction of the capture that points up: x, y, z, -x, -y or -z (`--up=-y`), or three numbers
    (`--up=0.1,-0.9,0.4`). By default as the format says, or a guess from floors, walls and how the
    cameras were held."""

    max_frames: int = 400
    """Images to use at most, evenly spread."""

    depth_scale: float = 1.0
    """Multiply all depths of depth images, where their unit is not the one that was read."""

    depth_along_ray: bool = False
    """Depth images hold the distance along each pixel's ray, as those of Hypersim and SceneNet do,
    and not z: convert it."""

    surfaces: Surfaces = "auto"
    """Where depth comes from: depth images (`depth`), a comparison of the photos (`sweep`), a
    trained splat (`model`, with --model) or the sparse points alone (`points`). By default the best
    that the capture has."""

    model: Path | None = None
    """Trained splat (.ply of gsplat, nerfstudio, INRIA's 3DGS, Brush or Postshot) in the capture's
    coordinates: its depth is taken as the surfaces."""

    trust_depth: bool = False
    """Take the depth images as they are, even if they contradict the poses or each other."""

    def __post_init__(self) -> None:
        """Refuses what makes no sense."""
        for name in ("voxel_size", "max_range"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                raise InputError(f"--{name.replace('_', '-')} must be positive, got {value}")
        if self.surfaces == "model" and self.model is None:
            raise InputError("--surfaces model takes a trained splat: give --model scene.ply")
        if self.model is not None and self.surfaces not in ("auto", "model"):
            raise InputError(f"--model and --surfaces {self.surfaces} exclude each other")
        at_least(self, {"max_frames": 2})


def at_least(settings: object, least: dict[str, int]) -> None:
    """Refuses settings below their least values.

    Raises:
        ValueError: names the option.
    """
    for name, value in least.items():
        if getattr(settings, name) < value:
            option = name.replace("_", "-")
            raise InputError(f"--{option} must be at least {value}, got {getattr(settings, name)}")
