"""The options of the commands that train and judge splats."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import tyro

from r3jax.cli.options.bags import BagOptions


@dataclass(frozen=True, kw_only=True)
class ModelOptions:
    """What is optimized."""

    TITLE: ClassVar[str] = "model"

    strategy: Literal["vanilla", "mcmc"] = "vanilla"
    """`vanilla`: clone, split, prune, reset. `mcmc`: relocation and noise within a fixed budget."""

    gaussians: int = 50_000
    """Gaussians at the start, on the recorded surfaces."""

    capacity: int | None = None
    """Gaussians that there may ever be; by default twice those of the start."""

    background: Literal["black", "white", "random"] = "black"
    """Color behind everything."""


@dataclass(frozen=True, kw_only=True)
class ModelFolderOptions:
    """Where a model is kept."""

    TITLE: ClassVar[str] = "folder"

    name: str = "last"
    """Name of the model."""

    out: Path | None = None
    """Folder that holds the models; by default RUN/models, for a recording runs/NAME/models."""

    overwrite: bool = False
    """Replace the model of that name if there is one."""

    resume: bool = False
    """Go on from the newest checkpoint of that model; the result is the same as without a break."""


@dataclass(frozen=True, kw_only=True)
class RenderingOptions(BagOptions):
    """How splats are rendered, and how a recording is read."""

    TITLE: ClassVar[str] = "machine and recording"

    backend: Literal["auto", "numba", "xla", "splax"] = "auto"
    """Rasterizer: numba on CPUs, splax on NVIDIA GPUs if installed, xla elsewhere."""

    up: Literal["y", "z"] = "y"
    """Axis of a recording's world that points up."""

    seed: int = 0
    """All randomness follows from it."""


@dataclass(frozen=True)
class TrainOptions(ModelFolderOptions, ModelOptions, RenderingOptions):
    """Train 3D Gaussian splatting from scratch on a run or a recording."""

    EXAMPLES: ClassVar[tuple[str, ...]] = (
        "r3jax train runs/flat-ours-pano-seed0",
        "r3jax train runs/flat-ours-pano-seed0 --iterations 30000 --name long",
    )

    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """A run folder, or a recording (images/, depth/, poses.txt, K.txt)."""

    iterations: int = 7000
    """Steps of the optimizer; schedules shrink with it."""

    resolution: int | None = None
    """Longer side of the training images [px]; by default as recorded."""

    hold_out: int = 8
    """Keep every N-th view for `r3jax evaluate`; 0 trains on all."""

    views_per_step: int = 1
    """Views whose losses are averaged for one step."""


@dataclass(frozen=True, kw_only=True)
class ResultOptions:
    """What is written."""

    TITLE: ClassVar[str] = "results"

    out: Path | None = None
    """Folder for the results; by default RUN/report, for a recording the model's folder."""

    rows: Literal["csv", "parquet"] = "csv"
    """Kind of the file with one row per view."""

    worst: int = 8
    """Views on the contact sheet; 0 draws none."""

    no_renderability: bool = False
    """Do not map the training views to set the map's expectation beside the result."""


@dataclass(frozen=True)
class EvaluateOptions(ResultOptions, RenderingOptions):
    """Judge a model by test views: PSNR, SSIM, LPIPS, their tails, and the worst views."""

    EXAMPLES: ClassVar[tuple[str, ...]] = (
        "r3jax evaluate runs/flat-ours-pano-seed0",
        "r3jax evaluate runs/flat-ours-pano-seed0 --views runs/flat-random-seed0",
    )

    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The run or the recording that the model was trained on."""

    views: Annotated[str, tyro.conf.arg(metavar="SPEC")] = "heldout"
    """Test views: `heldout` (those that the training left out), `all`, `every:N` (views 0, N, 2N,
    ...), or the folder of another run or recording of the same place."""

    name: str = "last"
    """Name of the model, as given to `r3jax train`."""

    model: Annotated[Path | None, tyro.conf.arg(metavar="PLY")] = None
    """The model's file, if it lies elsewhere."""

    lpips: Literal["alex", "vgg", "none"] = "alex"
    """Network of LPIPS; `none` leaves it out."""

    resolution: int | None = None
    """Longer side of the images [px]; by default that of the training."""
