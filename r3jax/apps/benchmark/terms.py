"""What all cells of a benchmark have in common, as the command line names it.

Light on purpose: `r3jax benchmark --help` shows these fields, and must not wait for JAX.
"""

from dataclasses import dataclass
from typing import Literal

from r3jax.errors import InputError


@dataclass(frozen=True, kw_only=True)
class ExplorationTerms:
    """Sensor, map and clock of every exploration."""

    clock: Literal["wall", "model"] = "wall"
    """`wall`: measured planning and mapping, plus flight. `model`: fixed costs, repeatable."""

    resolution: int = 256
    """Width and height of the explored images [px]."""

    fov: float = 60.0
    """Field of view [degrees]."""

    noise: float = 0.01
    """Standard deviation of the explored depth as a share of the depth; test views have none."""

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
    """Width and height of the images that are used for training and evaluation [px]."""

    iterations: int = 2000
    """Steps of every training."""

    gaussians: int = 20_000
    """Gaussians at the start of every training."""

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
    """Refuses a width of images that leaves nothing to compare, or is too large.

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
