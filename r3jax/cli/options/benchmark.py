"""The options of `r3jax benchmark`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import tyro


@dataclass(frozen=True, kw_only=True)
class ExplorationOptions:
    """On what terms every policy explores."""

    TITLE: ClassVar[str] = "exploration"

    clock: Literal["wall", "model"] = "wall"
    """`wall`: measured planning and mapping + flight. `model`: fixed costs, repeatable."""

    capture_every: Annotated[float | None, tyro.conf.arg(metavar="LENGTH")] = None
    """All policies capture frames on the way, at most so far apart [m]; by default none does."""

    capture_rate: Annotated[float | None, tyro.conf.arg(metavar="RATE")] = None
    """The same by frames per second of the flight [Hz]."""

    gaze: Literal["ahead", "panorama"] = "panorama"
    """Where the camera looks on the way, as `r3jax explore --help` tells."""

    plan_while_moving: bool = False
    """All policies decide on the next view during the flight."""

    resolution: int = 256
    """Width and height of the explored images [px]."""

    fov: float = 60.0
    """Field of view [degrees]."""

    noise: float = 0.01
    """Standard deviation of the explored depth as a share of the depth; test views have none."""

    max_range: float = 5.0
    """Range of the depth sensor [m]."""

    voxel_size: float = 0.05
    """Edge of a voxel of the map [m]."""

    settings: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """Settings of all policies: `num_candidates=50`, `lambda2=0.3`, `scoring.lambda1=8`, ..."""


@dataclass(frozen=True, kw_only=True)
class TrainingOptions:
    """On what terms every model is trained and judged."""

    TITLE: ClassVar[str] = "training and judging"

    train_resolution: int = 128
    """Width and height of the images that are trained on and judged [px]."""

    iterations: int = 2000
    """Steps of every training."""

    gaussians: int = 20_000
    """Gaussians at the start of every training."""

    capacity: int = 40_000
    """Gaussians that there may ever be."""

    test_views: int = 120
    """Test views of a scene at most, 6 or more; 0 takes all of the lattice."""

    lpips: Literal["alex", "vgg", "none"] = "alex"
    """Network of LPIPS; `none` leaves it out."""

    backend: Literal["auto", "numba", "xla", "splax"] = "auto"
    """Rasterizer: numba on CPUs, splax on NVIDIA GPUs if installed, xla elsewhere."""


@dataclass(frozen=True, kw_only=True)
class MeshOptions:
    """How mesh files are opened."""

    TITLE: ClassVar[str] = "mesh files"

    up: Literal["y", "z"] | None = None
    """Vertical axis of mesh files; by default y for GLB and glTF, z for the others. Of recordings
    (--photos) y by default."""

    scale: float = 1.0
    """Meters in a unit of the mesh files: 0.001 for files in millimeters."""

    cull_backfaces: bool = False
    """Look through faces seen from behind, as Habitat-Sim always does."""


@dataclass(frozen=True, kw_only=True)
class MachineOptions:
    """Where the cells run."""

    TITLE: ClassVar[str] = "machines"

    engine: Literal["local", "slurm"] = "local"
    """`local`: processes on this machine, one GPU each where there are several. `slurm`: an array
    job, pre-emption safe."""

    jobs: int = 1
    """Cells at a time; 0: one by one in this very process, for debugging."""

    slurm: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """Parameters of the array job, as submitit calls them: `timeout_min=240`,
    `slurm_partition=gpu`, `gpus_per_node=1`, ..."""


@dataclass(frozen=True, kw_only=True)
class SubmissionOptions:
    """Views that were chosen elsewhere."""

    TITLE: ClassVar[str] = "submissions"

    submission: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE")] = ()
    """Judge these submissions (`r3jax export --format submission` writes one): check them, take
    their frames again, train and judge. Scene, seed, budget and sensor are their own; where a mesh
    lies, --scenes tells."""

    check: bool = False
    """With --submission: check and do no more. Exits with 1 if a rule is broken."""


@dataclass(frozen=True, kw_only=True)
class SiteOptions:
    """A page of what is there."""

    TITLE: ClassVar[str] = "page"

    site: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Write a static page of all records in --out into this folder, and do no more: tables with
    intervals, pictures of the worst views, how fast this machine is."""


@dataclass(frozen=True, kw_only=True)
class PhotoOptions:
    """Choice among the photos of a capture (COVER's protocol)."""

    TITLE: ClassVar[str] = "photos"

    photos: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="PATH")] = ()
    """Choose among the photos of these captures with depth, while a model trains on those chosen;
    every eighth photo judges. Policies by default: ours,cover,gavis,random; --iterations count
    after the last photo."""

    choose: int = 20
    """Photos that are chosen."""

    first: int = 10
    """Photos that every choice begins with, drawn by the seed."""

    nearest: int = 5
    """Candidates of a choice: the photos nearest to the last one."""

    every: int = 200
    """Steps of training between two choices."""


@dataclass(frozen=True)
class BenchmarkOptions(
    SubmissionOptions,
    SiteOptions,
    PhotoOptions,
    ExplorationOptions,
    TrainingOptions,
    MeshOptions,
    MachineOptions,
):
    """Compare policies on equal terms: explore, train and judge scenes x policies x seeds."""

    EXAMPLES: ClassVar[tuple[str, ...]] = (
        "r3jax benchmark --scenes flat,office --policies ours,random --seeds 0,1",
        "r3jax benchmark --budget views:60 --snapshots views:30,views:60 --jobs 2",
        "r3jax benchmark --submission theirs.jsonl --check",
        "r3jax benchmark --photos captures/lounge --choose 12 --seeds 0,1,2",
    )

    scenes: Annotated[str, tyro.conf.arg(metavar="A,B")] = "flat,office"
    """Comma-separated scenes: embedded ones by name, `mesh:<file>`, `replica:<name>`,
    `habitat:<file>`."""

    policies: Annotated[str, tyro.conf.arg(metavar="A,B")] = "ours,ours-pano,frontier,random"
    """Who chooses the views, with commas between: names, `module:Class`, `exec:COMMAND`."""

    seeds: Annotated[str, tyro.conf.arg(metavar="0,1")] = "0"
    """Each makes an exploration and a training of its own."""

    budget: Annotated[str, tyro.conf.arg(metavar="BUDGET")] = "views:60"
    """When every exploration stops: `views:N`, `seconds:S` of the mission clock, or `meters:M`."""

    snapshots: Annotated[str | None, tyro.conf.arg(metavar="A,B")] = None
    """Where a model is trained and judged, for example `views:30,views:60`; by default at the
    budget."""

    out: Path = Path("runs/benchmark")
    """Folder of the results. What is done in it is not done again; an interrupted benchmark
    goes on when it is started again with the same words."""
