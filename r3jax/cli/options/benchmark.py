"""The options of `r3jax benchmark`."""

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import arg

from r3jax.cli.options.groups import (
    check_folder,
    check_policy_here,
    check_resolution,
    check_scene,
    refuse_others,
)
from r3jax.errors import InputError
from r3jax.exploration.config import parse_budget
from r3jax.formats.errors import check_capture

_WITH_SUBMISSION = (
    "submission", "check", "scenes", "snapshots", "out", "train_resolution", "iterations",
    "gaussians", "capacity", "test_views", "lpips", "backend", "engine", "jobs", "slurm",
)  # fmt: skip
_WITH_PHOTOS = (
    "photos", "choose", "first", "nearest", "every", "policies", "seeds", "out", "up",
    "max_range", "voxel_size", "train_resolution", "iterations", "gaussians", "capacity", "lpips",
    "backend",
)  # fmt: skip
"""Options that make sense beside these."""


@dataclass(frozen=True, kw_only=True)
class ExplorationOptions:
    """On what terms every policy explores."""

    clock: Literal["wall", "model"] = "wall"
    """`wall`: measured planning and mapping + flight. `model`: fixed costs, repeatable."""

    capture_every: Annotated[float | None, arg(metavar="LENGTH")] = None
    """All policies capture frames while moving, at most this far apart [m]; by default
    none does."""

    capture_rate: Annotated[float | None, arg(metavar="RATE")] = None
    """As --capture-every, by frame rate [Hz]."""

    gaze: Literal["ahead", "panorama"] = "panorama"
    """Where the camera points while moving, as in `r3jax explore --help`."""

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

    settings: Annotated[tuple[str, ...], arg(metavar="NAME=VALUE")] = ()
    """Settings of all policies: `num_candidates=50`, `lambda2=0.3`, `scoring.lambda1=8`, ..."""


@dataclass(frozen=True, kw_only=True)
class TrainingOptions:
    """On what terms every model is trained and judged."""

    train_resolution: int = 128
    """Width and height of the images that are trained on and judged [px]."""

    iterations: int = 2000
    """Steps of every training."""

    gaussians: int = 20_000
    """Gaussians at the start of every training."""

    capacity: int = 40_000
    """Maximum number of Gaussians."""

    test_views: int = 120
    """Test views of a scene at most, 6 or more; 0 takes all of the lattice."""

    lpips: Literal["alex", "vgg", "none"] = "alex"
    """Network of LPIPS; `none` leaves it out."""

    backend: Literal["auto", "numba", "xla", "splax"] = "auto"
    """Rasterizer: numba on CPUs, splax on NVIDIA GPUs if installed, xla elsewhere."""


@dataclass(frozen=True, kw_only=True)
class MeshOptions:
    """How mesh files are opened."""

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

    engine: Literal["local", "slurm"] = "local"
    """`local`: processes on this machine, one GPU each where there are several. `slurm`: an array
    job, pre-emption safe."""

    jobs: int = 1
    """Cells at a time; 0: one by one in this very process, for debugging."""

    slurm: Annotated[tuple[str, ...], arg(metavar="NAME=VALUE")] = ()
    """Parameters of the array job, as submitit calls them: `timeout_min=240`,
    `slurm_partition=gpu`, `gpus_per_node=1`, ..."""

    def __post_init__(self) -> None:
        """Refuses fewer cells at a time than none, and parameters without a name."""
        if self.jobs < (1 if self.engine == "slurm" else 0):
            raise InputError(f"--jobs must not be negative (slurm: at least 1), got {self.jobs}")
        _ = self.parameters

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters of the array job."""
        return parse_settings("slurm", self.slurm)


@dataclass(frozen=True, kw_only=True)
class SubmissionOptions:
    """Views that were chosen elsewhere."""

    submission: Annotated[tuple[Path, ...], arg(metavar="FILE")] = ()
    """Judge these submissions (`r3jax export --format submission` writes one): check them, take
    their frames again, train and judge. Scene, seed, budget and sensor come from the submission;
    use --scenes to locate mesh files."""

    check: bool = False
    """With --submission: check only. Exits with 1 if a rule is broken."""

    def __post_init__(self) -> None:
        """Refuses what is no file."""
        if self.check and not self.submission:
            raise InputError("--check belongs to --submission FILE")
        for path in self.submission:
            if not path.is_file():
                is_folder = path.is_dir()
                what = "this is a folder; a submission is a file" if is_folder else "no such file"
                raise InputError(f"{path}: {what}")


@dataclass(frozen=True, kw_only=True)
class SiteOptions:
    """A page of what is there."""

    site: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """Only write a static page of all records in --out into this folder: tables with
    intervals, pictures of the worst views, how fast this machine is."""


@dataclass(frozen=True, kw_only=True)
class PhotoOptions:
    """Choice among the photos of a capture (COVER's protocol)."""

    photos: Annotated[tuple[Path, ...], arg(metavar="PATH")] = ()
    """Choose among the photos of these captures with depth, while a model trains on those chosen;
    every eighth photo judges. Policies by default: r3,cover,gavis,random; --iterations count
    after the last photo."""

    choose: int = 20
    """Photos that are chosen."""

    first: int = 10
    """Photos that every choice begins with, drawn by the seed."""

    nearest: int = 5
    """Candidates of a choice: the photos nearest to the last one."""

    every: int = 200
    """Steps of training between two choices."""

    def __post_init__(self) -> None:
        """Refuses what is no capture."""
        for path in self.photos:
            check_capture(path)


@dataclass(frozen=True, kw_only=True)
class BenchmarkOptions:
    """Compare policies on equal terms: explore, train and judge scenes x policies x seeds.

    For example
        r3jax benchmark --scenes flat,office --policies r3,random --seeds 0,1
        r3jax benchmark --budget views:60 --snapshots views:30,views:60 --jobs 2
        r3jax benchmark --submission theirs.jsonl --check
        r3jax benchmark --photos captures/lounge --choose 12 --seeds 0,1,2
    """

    scenes: Annotated[str, arg(metavar="A,B")] = "flat,office"
    """Comma-separated scenes: embedded ones by name, `mesh:<file>`, `replica:<name>`,
    `habitat:<file>`."""

    policies: Annotated[str, arg(metavar="A,B")] = "r3,r3-pano,frontier,random"
    """Comma-separated policies: names, `module:Class`, `exec:COMMAND`."""

    seeds: Annotated[str, arg(metavar="0,1")] = "0"
    """Comma-separated seeds: one exploration and one training each."""

    budget: Annotated[str, arg(metavar="BUDGET")] = "views:60"
    """When every exploration stops: `views:N`, `seconds:S` of the mission clock, or `meters:M`."""

    snapshots: Annotated[str | None, arg(metavar="A,B")] = None
    """Where a model is trained and judged, for example `views:30,views:60`; by default at the
    budget."""

    out: Path = Path("runs/benchmark")
    """Folder of the results. Finished cells are skipped: run the same command again to resume."""

    exploration: ExplorationOptions = field(default_factory=ExplorationOptions)
    training: Annotated[TrainingOptions, arg(name="training and judging")] = field(
        default_factory=TrainingOptions
    )
    meshes: Annotated[MeshOptions, arg(name="mesh files")] = field(default_factory=MeshOptions)
    machines: MachineOptions = field(default_factory=MachineOptions)
    submissions: SubmissionOptions = field(default_factory=SubmissionOptions)
    page: SiteOptions = field(default_factory=SiteOptions)
    pool: Annotated[PhotoOptions, arg(name="photos")] = field(default_factory=PhotoOptions)

    @property
    def seed_numbers(self) -> tuple[int, ...]:
        """The seeds.

        Raises:
            ValueError: not whole numbers, or one that no training takes.
        """
        try:
            seeds = tuple(int(seed) for seed in words(self.seeds))
        except ValueError:
            raise InputError(f"--seeds are whole numbers with commas, got {self.seeds!r}") from None
        for seed in seeds:
            if not 0 <= seed < 1 << 31:
                raise InputError(f"--seeds must lie between 0 and 2^31 - 1, got {seed}")
        return seeds

    def __post_init__(self) -> None:
        """Refuses what can be seen to be wrong before JAX is imported and a scene is opened."""
        if self.page.site is not None:
            refuse_others(self, "--site", "records", ("site", "out"))
            check_folder(self.page.site)
        if self.submissions.submission:
            refuse_others(self, "--submission", "submission", _WITH_SUBMISSION)
            if self.scenes != BenchmarkOptions.scenes and not self.scenes.startswith("mesh:"):
                raise InputError("--scenes locates the mesh of a submission: mesh:<file>")
        if self.pool.photos:
            refuse_others(self, "--photos", "captures", _WITH_PHOTOS)
            check_resolution(self.training.train_resolution)
        for scene in words(self.scenes):
            check_scene(scene, self.meshes.scale)
        for policy in words(self.policies):
            check_policy_here(policy)
        for budget in (self.budget, *words(self.snapshots or "")):
            parse_budget(budget)
        _ = self.seed_numbers
        check_folder(self.out)


def words(text: str) -> tuple[str, ...]:
    """Splits a text at its commas."""
    return tuple(word.strip() for word in text.split(",") if word.strip())


def parse_settings(option: str, given: Iterable[str]) -> dict[str, Any]:
    """Reads `NAME=VALUE` words; a value that is no number, true or false is a text.

    Raises:
        ValueError: a word without a name or without a value; names the option.
    """
    settings: dict[str, Any] = {}
    for word in given:
        name, separator, text = word.partition("=")
        if not (name and separator):
            raise InputError(f"--{option} takes NAME=VALUE, got {word!r}")
        try:
            settings[name] = json.loads(text)
        except ValueError:
            settings[name] = text
    return settings
