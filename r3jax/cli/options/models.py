"""The options of the commands that train splats and evaluate them."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from r3jax.cli.options.groups import ReadingOptions, check_model
from r3jax.errors import InputError


@dataclass(frozen=True, kw_only=True)
class ModelOptions:
    """What is optimized."""

    strategy: Literal["vanilla", "mcmc"] = "vanilla"
    """`vanilla`: clone, split, prune, reset. `mcmc`: relocation and noise within a fixed budget."""

    gaussians: int = 50_000
    """Gaussians at the start, on the recorded surfaces."""

    capacity: int | None = None
    """Maximum number of Gaussians; by default twice those of the start."""

    background: Literal["black", "white", "random"] = "black"
    """Color behind everything."""


@dataclass(frozen=True, kw_only=True)
class ModelFolderOptions:
    """Where a model is kept."""

    name: str = "last"
    """Name of the model."""

    out: Path | None = None
    """Folder that holds the models; by default RUN/models, for a recording runs/NAME/models."""

    overwrite: bool = False
    """Overwrite an existing model of that name."""

    resume: bool = False
    """Resume from the newest checkpoint of that model; the result is the same as without a
    break."""


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
    """Steps of the optimizer; schedules shrink with it."""

    resolution: int | None = None
    """Longer side of the training images [px]; by default as recorded."""

    hold_out: int = 8
    """Keep every N-th view for `r3jax evaluate`; 0 trains on all."""

    views_per_step: int = 1
    """Views whose losses are averaged for one step."""

    folder: ModelFolderOptions = field(default_factory=ModelFolderOptions)
    model: ModelOptions = field(default_factory=ModelOptions)
    reading: Annotated[ReadingOptions, arg(name="machine and recording")] = field(
        default_factory=ReadingOptions
    )

    def __post_init__(self) -> None:
        """Refuses what no model can be trained on, and what none can be called."""
        check_model(self.path, self.folder.name, self.resolution)
        if self.hold_out >= 1 << 31:
            raise InputError(f"--hold-out must be below 2^31, got {self.hold_out}")


@dataclass(frozen=True, kw_only=True)
class ResultOptions:
    """What is written."""

    out: Path | None = None
    """Folder for the results; by default RUN/report, for a recording the model's folder."""

    rows: Literal["csv", "parquet"] = "csv"
    """Kind of the file with one row per view."""

    worst: int = 8
    """Views on the contact sheet; 0 draws none."""

    no_renderability: bool = False
    """Do not map the training views to set the map's expectation beside the result."""

    def __post_init__(self) -> None:
        """Refuses fewer views than none."""
        if self.worst < 0:
            raise InputError(f"--worst must not be negative, got {self.worst}")


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """Evaluate a model on test views: PSNR, SSIM and LPIPS, their tails, and the worst views.

    For example
        r3jax evaluate runs/flat-r3-pano-seed0
        r3jax evaluate runs/flat-r3-pano-seed0 --views runs/flat-random-seed0
    """

    path: Annotated[Path, Positional, arg(metavar="RUN")]
    """The run or the recording that the model was trained on."""

    views: Annotated[str, arg(metavar="SPEC")] = "heldout"
    """Test views: `heldout` (those that the training left out), `all`, `every:N` (views 0, N, 2N,
    ...), or the folder of another run or recording of the same place."""

    name: str = "last"
    """Name of the model, as given to `r3jax train`."""

    model: Annotated[Path | None, arg(metavar="PLY")] = None
    """The model's file, if it lies elsewhere."""

    lpips: Literal["alex", "vgg", "none"] = "alex"
    """Network of LPIPS; `none` leaves it out."""

    resolution: int | None = None
    """Longer side of the images [px]; by default that of the training."""

    results: ResultOptions = field(default_factory=ResultOptions)
    reading: Annotated[ReadingOptions, arg(name="machine and recording")] = field(
        default_factory=ReadingOptions
    )

    def __post_init__(self) -> None:
        """Refuses a path, a name or a size that no evaluation takes."""
        check_model(self.path, self.name, self.resolution)
