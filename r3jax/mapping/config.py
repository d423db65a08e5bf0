"""Settings of the map and the grid. Plain numbers: they go into run.json as they are."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from r3jax.errors import InputError

MAX_CAPACITY = 1 << 27
"""Maximum number of rows of a map (5 GB)."""


@dataclass(frozen=True)
class MappingConfig:
    """How frames join a map and a grid.

    Raises:
        ValueError: a setting that cannot work.
    """

    voxel_size: float = 0.05
    """Voxel size [m]."""

    num_bins: int = 64
    """Direction bins per voxel."""

    capacity: int = 1 << 17
    """Initial number of rows of the map, a power of two."""

    allow_growth: bool = True
    """Double the table before it is 70 % full. If False, voxels beyond its capacity are dropped and
    counted."""

    drop_edges: bool = True
    """Ignore pixels on depth edges, whose color mixes two surfaces."""

    remove_moved: bool = True
    """Remove voxels that later frames see through, such as a person who has moved on, or stray
    measurements. Takes one byte per row."""

    cell_size: float = 0.2
    """Cell size of the coarse occupancy grid [m]."""

    tiles: bool = False
    """Hold what lies round the robot at hand and all else in tiles: for places larger than a house,
    with r3, r3-pano, r3-ahead or frontier. The rows then follow from range and voxel size, where
    `capacity` is not larger."""

    max_range: float = 5.0
    """Range of the depth sensor [m]."""

    body_radius: float = 0.3
    """Radius of the ball around each camera position that counts as free [m]."""

    start_radius: float = 0.5
    """Radius of the ball around the start that is assumed to be free [m]."""

    def __post_init__(self) -> None:
        """Refuses invalid settings."""
        for name in ("voxel_size", "cell_size", "max_range"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise InputError(f"{name} must be positive, got {getattr(self, name)}")
        for name in ("voxel_size", "cell_size"):
            if not 1e-3 <= getattr(self, name) <= 1e3:
                raise InputError(
                    f"{name} must lie between 0.001 and 1000 m, got {getattr(self, name)}"
                )
        if self.num_bins < 1:
            raise InputError(f"num_bins must be at least 1, got {self.num_bins}")
        # Hashes are masked with capacity - 1, and probes visit all slots of such sizes only.
        if self.capacity < 2 or self.capacity & (self.capacity - 1):
            raise InputError(f"capacity must be a power of two >= 2, got {self.capacity}")
        if self.capacity > MAX_CAPACITY:
            raise InputError(f"capacity must be at most {MAX_CAPACITY}, got {self.capacity}")


def mapping_config_of(settings: Mapping[str, Any]) -> MappingConfig:
    """Reads what concerns the map out of stored settings, which may be those of an exploration.

    Raises:
        TypeError, ValueError: a setting that cannot be used.
    """
    known = {field.name for field in fields(MappingConfig)}
    return MappingConfig(**{name: x for name, x in settings.items() if name in known})
