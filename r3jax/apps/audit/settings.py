"""Settings of an audit, which are options of `r3jax audit`, too. Its import is light."""

import math
from dataclasses import dataclass

_LEAST = {"max_frames": 2, "folds": 2, "views": 0, "seed": 0}
"""Least values of settings that count something."""

_MOST_VIEWS = 200
"""More would make the report too long to read."""


@dataclass(frozen=True)
class AuditSettings:
    """How a capture is audited.

    Raises:
        ValueError: a setting that makes no sense; names the option.
    """

    voxel_size: float | None = None
    """Edge of a voxel in the capture's units; by default 5 cm, or from the depths."""

    max_range: float | None = None
    """Surfaces farther from a camera count as invisible, in the capture's units; by default 5 m,
    or from the depths."""

    up: str | None = None
    """Direction of the capture that points up: x, y, z, -x, -y or -z (`--up=-y`), or three numbers
    (`--up=0.1,-0.9,0.4`). By default as the format says, or a guess from floors, walls and how the
    cameras were held."""

    max_frames: int = 400
    """Images to use at most, evenly spread."""

    folds: int = 8
    """Own frames are judged by a map without every N-th image, themselves among them."""

    views: int = 10
    """Further views to suggest."""

    num_places: int = 64
    """Places at which views are looked for, at most."""

    num_standpoints: int = 24
    """Places from which every surface is evaluated: the first of the others, at most."""

    seed: int = 0
    """Seed of the random views that the suggested ones are compared with."""

    depth_scale: float = 1.0
    """Multiply all depths of depth images, where their unit is not the one that was read."""

    depth_along_ray: bool = False
    """Depth images hold the distance along each pixel's ray, as those of Hypersim and SceneNet do,
    and not z: convert it."""

    trust_depth: bool = False
    """Take the depth images as they are, even if they contradict the poses or each other."""

    def __post_init__(self) -> None:
        """Refuses what makes no sense."""
        for name in ("voxel_size", "max_range"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                raise ValueError(f"--{name.replace('_', '-')} must be positive, got {value}")
        for name, least in _LEAST.items():
            value = getattr(self, name)
            if value < least:
                option = name.replace("_", "-")
                raise ValueError(f"--{option} must be at least {least}, got {value}")
        if self.views > _MOST_VIEWS:
            raise ValueError(f"--views must be at most {_MOST_VIEWS}, got {self.views}")
