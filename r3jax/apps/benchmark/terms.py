"""Settings that all cells of a benchmark share, named like the command's options.

Imports nothing heavy: `r3jax benchmark --help` shows these fields and must not wait for JAX.
"""

from dataclasses import dataclass
from typing import Literal

from r3jax.errors import InputError


@dataclass(frozen=True, kw_only=True)
class ExplorationTerms:
    """Sensor, map and clock of every exploration."""

    clock: Literal["wall", "model"] = "wall"
    """Mission clock. `wall`: measured planning and mapping time plus travel time. `model`: fixed
    costs plus travel time, repeatable."""

    resolution: int = 256
    """Width and height of the images during exploration [px]."""

    fov: float = 60.0
    """Field of view [degrees]."""

    noise: float = 0.01
    """Standard deviation of the depth noise during exploration, relative to the depth."""

    max_range: float = 5.0
    """Range of the depth sensor [m]."""

    voxel_size: float = 0.05
    """Voxel size [m]."""

    def __post_init__(self) -> None:
        """Refuses images that are too small to compare, or too large."""
        check_size("resolution", self.resolution)


@dataclass(frozen=True, kw_only=True)
class TrainingTerms:
    """Size and length of every training, and how its model is evaluated."""

    train_resolution: int = 128
    """Width and height of the images for training and evaluation [px]."""

    iterations: int = 2000
    """Training steps."""

    gaussians: int = 20_000
    """Initial number of Gaussians."""

    capacity: int = 40_000
    """Maximum number of Gaussians."""

    lpips: Literal["alex", "vgg", "none"] = "alex"
    """Network of LPIPS; `none` leaves it out."""

    backend: Literal["auto", "numba", "xla", "splax"] = "auto"
    """Rasterizer: numba on CPUs, splax on NVIDIA GPUs if installed, xla elsewhere."""

    def __post_init__(self) -> None:
        """Refuses images that are too small to compare, or too large."""
        check_size("train_resolution", self.train_resolution)


def check_size(name: str, pixels: int | None, most: int | None = 4096) -> None:
    """Refuses an image size that is too small to compare, or too large.

    Args:
        name: of the setting.
        pixels: its value; None is the default.
        most: largest one that is taken; None: any.

    Raises:
        InputError: fewer than 16 pixels, or more than the most.
    """
    if pixels is None or 16 <= pixels <= (most or pixels):
        return
    bounds = "be at least 16" if most is None else f"lie between 16 and {most}"
    raise InputError(f"{name} (--{name.replace('_', '-')}) must {bounds}, got {pixels}")
