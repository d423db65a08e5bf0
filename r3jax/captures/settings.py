"""Settings for reading and mapping a capture; also options of commands. Imports nothing heavy."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from r3jax.errors import InputError
from r3jax.formats.cut import Cut

Surfaces = Literal["auto", "depth", "sweep", "model", "points"]
"""Sources of depth; see `captures.surfaces`."""


@dataclass(frozen=True)
class SurveySettings:
    """Settings for reading a capture and for the resolution of its map.

    Raises:
        ValueError: an invalid setting; names the option.
    """

    voxel_size: float | None = None
    """Voxel size in the capture's units; by default 5 cm, or derived from the depths if the scale
    is unknown."""

    max_range: float | None = None
    """Range of the sensor in the capture's units; farther surfaces are ignored. By default 5 m, or
    derived from the depths if the scale is unknown."""

    up: str | None = None
    """Up direction in the capture's coordinates: x, y, z, -x, -y or -z (`--up=-y`), or three
    numbers (`--up=0.1,-0.9,0.4`). By default that of the format, or estimated from floors, walls
    and the cameras' orientation."""

    max_frames: int = 400
    """Maximum number of images to use, evenly spread over the capture."""

    depth_scale: float = 1.0
    """Factor for all depth images, if their unit was misinterpreted."""

    depth_along_ray: bool = False
    """Depth images contain distances along each pixel's ray (as in Hypersim and SceneNet) instead
    of z: convert them."""

    surfaces: Surfaces = "auto"
    """Source of depth: depth images (`depth`), multi-view stereo by plane sweep (`sweep`), a
    trained splat (`model`, with --model) or sparse points only (`points`). By default the best
    source that the capture has."""

    model: Path | None = None
    """Trained splat (.ply of gsplat, nerfstudio, INRIA's 3DGS, Brush or Postshot) in the capture's
    coordinates; depth is rendered from it."""

    hide_below: float = 25.0
    """Of 360 photos, this many degrees around the direction below the camera are masked: the hand,
    person or tripod that holds it. 0 masks nothing."""

    overlap_360: float = 10.0
    """Angle that neighboring views of a 360 photo share [deg]; it is cut into six pinhole views of
    90 degrees and this angle."""

    trust_depth: bool = False
    """Use the depth images even if they contradict the poses or each other."""

    def __post_init__(self) -> None:
        """Refuses invalid or contradictory settings."""
        for name in ("voxel_size", "max_range"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                raise InputError(f"--{name.replace('_', '-')} must be positive, got {value}")
        if self.surfaces == "model" and self.model is None:
            raise InputError("--surfaces model needs a trained splat: give --model scene.ply")
        if self.model is not None and self.surfaces not in ("auto", "model"):
            raise InputError(f"--model and --surfaces {self.surfaces} exclude each other")
        at_least(self, {"max_frames": 2})
        _ = self.cut

    @property
    def cut(self) -> Cut:
        """How photos of 360 degrees are cut into views."""
        return Cut(self.overlap_360, self.hide_below)


def at_least(settings: object, least: dict[str, int]) -> None:
    """Refuses settings below their minimum.

    Raises:
        ValueError: names the option.
    """
    for name, value in least.items():
        if getattr(settings, name) < value:
            option = name.replace("_", "-")
            raise InputError(f"--{option} must be at least {value}, got {getattr(settings, name)}")
