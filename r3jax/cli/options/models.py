"""The options of the commands that train splats and evaluate them."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from r3jax.cli.options.groups import ReadingOptions, check_model
from r3jax.errors import InputError


@dataclass(frozen=True, kw_only=True)
class ModelOptions:
    """The Gaussians and how they are optimized."""

    strategy: Literal["vanilla", "mcmc"] = "vanilla"
    """`vanilla`: clone, split, prune, reset. `mcmc`: relocation and noise within a fixed budget."""

    gaussians: int = 50_000
    """Initial number of Gaussians, placed on the recorded surfaces."""

    capacity: int | None = None
    """Maximum number of Gaussians; by default twice the initial number."""

    background: Literal["black", "white", "random"] = "black"
    """Background color."""


@dataclass(frozen=True, kw_only=True)
class ModelFolderOptions:
    """Where the model is stored."""

    name: str = "last"
    """Name of the model."""

    out: Path | None = None
    """Folder for models; by default RUN/models, for a recording runs/NAME/models."""

    overwrite: bool = False
    """Overwrite an existing model of that name."""

    resume: bool = False
    """Resume from the newest checkpoint of that model; the result equals that of an uninterrupted
    training."""


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """Train 3D Gaussian splatting from scratch on a run or a recording.

    For example
        r3jax train runs/flat-r3-pano-seed0
        r3jax train runs/flat-r3-pano-seed0 --iterations 30000 --name long
    """

    path: Annotated[Path, Positional, arg(metavar="RUN")]
    """A run folder, or a recording (images/, depth/, poses.txt, K.txt)."""

    iterations: int = 7000
    """Optimization steps; the schedules scale with it."""

    resolution: int | None = None
    """Longer side of the training images [px]; by default the recorded size."""

    hold_out: int = 8
    """Hold out every N-th view for `r3jax evaluate`; 0: train on all."""

    views_per_step: int = 1
    """Batch size: views per optimization step."""

    folder: ModelFolderOptions = field(default_factory=ModelFolderOptions)
    model: ModelOptions = field(default_factory=ModelOptions)
    reading: Annotated[ReadingOptions, arg(name="machine and recording")] = field(
        default_factory=ReadingOptions
    )

    def __post_init__(self) -> None:
        """Refuses a path, a name or a size that no training takes."""
        check_model(self.path, self.folder.name, self.resolution)
        if self.hold_out >= 1 << 31:
            raise InputError(f"--hold-out must be below 2^31, got {self.hold_out}")


@dataclass(frozen=True, kw_only=True)
class ResultOptions:
    """Output files."""

    out: Path | None = None
    """Folder for the results; by default RUN/report, for a recording the model's folder."""

    rows: Literal["csv", "parquet"] = "csv"
    """Format of the table with one row per view."""

    worst: int = 8
    """Number of worst views on the contact sheet; 0: no contact sheet."""

    no_renderability: bool = False
    """Skip the mean renderability of the test views, which needs a map of the training views."""

    def __post_init__(self) -> None:
        """Refuses a negative number of views."""
        if self.worst < 0:
            raise InputError(f"--worst must not be negative, got {self.worst}")


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """Evaluate a model on test views: PSNR, SSIM and LPIPS (mean, 5th percentile, worst views).

    For example
        r3jax evaluate runs/flat-r3-pano-seed0
        r3jax evaluate runs/flat-r3-pano-seed0 --views runs/flat-random-seed0
    """

    path: Annotated[Path, Positional, arg(metavar="RUN")]
    """The run or the recording that the model was trained on."""

    views: Annotated[str, arg(metavar="SPEC")] = "heldout"
    """Test views: `heldout` (held out by the training), `all`, `every:N` (views 0, N, 2N, ...), or
    the folder of another run or recording of the same place."""

    name: str = "last"
    """Name of the model, as given to `r3jax train`."""

    model: Annotated[Path | None, arg(metavar="PLY")] = None
    """The model's PLY file, if it is stored elsewhere."""

    lpips: Literal["alex", "vgg", "none"] = "alex"
    """Network of LPIPS; `none` leaves it out."""

    resolution: int | None = None
    """Longer side of the images [px]; by default that of the training images."""

    results: ResultOptions = field(default_factory=ResultOptions)
    reading: Annotated[ReadingOptions, arg(name="machine and recording")] = field(
        default_factory=ReadingOptions
    )

    def __post_init__(self) -> None:
        """Refuses a path, a name or a size that no evaluation takes."""
        check_model(self.path, self.name, self.resolution)
