"""The options of `r3jax benchmark`."""

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from tyro.conf import UseAppendAction, arg

from r3jax.apps.benchmark.terms import ExplorationTerms, TrainingTerms
from r3jax.cli.options.groups import (
    MeshOptions,
    check_folder,
    check_policy_here,
    check_scene,
    refuse_others,
)
from r3jax.errors import InputError
from r3jax.exploration.config import parse_budget

_WITH_SUBMISSION = (
    "submission", "check", "scenes", "snapshots", "out", "train_resolution", "iterations",
    "gaussians", "capacity", "test_views", "lpips", "backend", "engine", "jobs", "slurm",
    "format", "reference",
)  # fmt: skip
"""Options that make sense beside it."""


@dataclass(frozen=True, kw_only=True)
class ExplorationOptions(ExplorationTerms):
    """How every policy explores."""

    capture_every: Annotated[float | None, arg(metavar="LENGTH")] = None
    """All policies capture frames while moving, at most this far apart [m]; by default
    none does."""

    capture_rate: Annotated[float | None, arg(metavar="RATE")] = None
    """As --capture-every, by frame rate [Hz]."""

    gaze: Literal["ahead", "panorama"] = "panorama"
    """Where the camera points while moving, as in `r3jax explore --help`."""

    plan_while_moving: bool = False
    """All policies decide on the next view during the flight."""

    settings: Annotated[tuple[str, ...], arg(metavar="NAME=VALUE")] = ()
    """Settings of all policies: `num_candidates=50`, `lambda2=0.3`, `scoring.lambda1=8`, ..."""

    sweep: Annotated[tuple[str, ...], UseAppendAction, arg(metavar="NAME=A,B")] = ()
    """Try each of these values of a setting, for every policy: `--sweep lambda2=0.2,0.5,0.8`; given
    twice, all combinations."""


@dataclass(frozen=True, kw_only=True)
class TrainingOptions(TrainingTerms):
    """How every model is trained and evaluated."""

    test_views: int = 120
    """Test views of a scene at most, 6 or more; 0 takes all of the lattice."""


@dataclass(frozen=True, kw_only=True)
class MachineOptions:
    """Where the cells (a scene, a policy, a seed) run."""

    engine: Literal["local", "slurm"] = "local"
    """`local`: processes on this machine, one per GPU. `slurm`: an array job that survives
    pre-emption."""

    jobs: int = 1
    """Cells to run in parallel; 0: one after the other in this process, for debugging."""

    slurm: Annotated[tuple[str, ...], arg(metavar="NAME=VALUE")] = ()
    """Parameters of the array job under submitit's names: `timeout_min=240`,
    `slurm_partition=gpu`, `gpus_per_node=1`, ..."""

    def __post_init__(self) -> None:
        """Refuses a negative number of cells, and parameters without a name."""
        if self.jobs < (1 if self.engine == "slurm" else 0):
            raise InputError(f"--jobs must not be negative (slurm: at least 1), got {self.jobs}")
        _ = self.parameters

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters of the array job."""
        return parse_settings("slurm", self.slurm)


@dataclass(frozen=True, kw_only=True)
class SubmissionOptions:
    """Views chosen elsewhere."""

    submission: Annotated[tuple[Path, ...], arg(metavar="FILE")] = ()
    """Evaluate submissions (written by `r3jax export --format submission`): check them, render
    their frames again, train and evaluate. Scene, seed, budget and sensor come from the submission;
    use --scenes to locate mesh files."""

    check: bool = False
    """With --submission: only check the rules; the exit code is 1 if one is broken."""

    def __post_init__(self) -> None:
        """Refuses a path that is not a file."""
        if self.check and not self.submission:
            raise InputError("--check belongs to --submission FILE")
        for path in self.submission:
            if not path.is_file():
                is_folder = path.is_dir()
                what = (
                    "this is a folder; a submission is a file"
                    if is_folder
                    else "there is no such file"
                )
                raise InputError(f"{path}: {what}")


@dataclass(frozen=True, kw_only=True)
class OutputOptions:
    """How the results are shown."""

    format: Literal["terminal", "csv", "latex", "markdown"] = "terminal"
    """How the tables are printed: `csv` with every digit and a line for each scene."""

    reference: Annotated[str | None, arg(metavar="METHOD")] = None
    """Method that the others are compared with on the same views, as the table calls it; by default
    the last of the table."""

    site: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """Only write a static results page of the records in --out into this folder: tables with
    intervals, curves, images of the worst views, and downloads."""


@dataclass(frozen=True, kw_only=True)
class BenchmarkOptions:
    """Compare policies on equal terms: explore, train and evaluate scenes x policies x seeds.

    For example
        r3jax benchmark --scenes flat,office --policies r3,random --seeds 0,1
        r3jax benchmark --budget views:60 --snapshots views:30,views:60 --jobs 2
        r3jax benchmark --policies r3-pano --sweep lambda2=0.2,0.5,0.8 --format latex
        r3jax benchmark --submission theirs.jsonl --check
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
    """Points of the run at which a model is trained and evaluated, such as `views:30,views:60`; by
    default the budget."""

    out: Path = Path("runs/benchmark")
    """Folder of the results. Finished cells are skipped: run the same command again to resume."""

    exploration: ExplorationOptions = field(default_factory=ExplorationOptions)
    training: Annotated[TrainingOptions, arg(name="training and evaluation")] = field(
        default_factory=TrainingOptions
    )
    meshes: Annotated[MeshOptions, arg(name="mesh files")] = field(default_factory=MeshOptions)
    machines: MachineOptions = field(default_factory=MachineOptions)
    submissions: SubmissionOptions = field(default_factory=SubmissionOptions)
    results: OutputOptions = field(default_factory=OutputOptions)

    RETIRED: ClassVar[dict[str, str]] = {
        "--photos": "use `r3jax select CAPTURE --frames N`; COVER's protocol is in commit 042e0d34",
    }
    """Options that have left, and what takes their place."""

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

    @property
    def sweeps(self) -> dict[str, list[Any]]:
        """The values to try, by setting.

        Raises:
            ValueError: a word that is not understood, a setting or value given twice.
        """
        given = parse_settings("settings", self.exploration.settings)
        return parse_sweeps(self.exploration.sweep, given)

    def __post_init__(self) -> None:
        """Refuses values that are wrong before JAX is imported and a scene is opened."""
        if self.results.site is not None:
            refuse_others(self, "--site", "records", ("site", "out", "reference"))
            check_folder(self.results.site)
        if self.submissions.submission:
            refuse_others(self, "--submission", "submission", _WITH_SUBMISSION)
            if self.scenes != BenchmarkOptions.scenes and not self.scenes.startswith("mesh:"):
                raise InputError("--scenes locates the mesh of a submission: mesh:<file>")
        for scene in words(self.scenes):
            check_scene(scene, self.meshes.scale)
        for policy in words(self.policies):
            check_policy_here(policy)
        for budget in (self.budget, *words(self.snapshots or "")):
            parse_budget(budget)
        _ = self.seed_numbers, self.sweeps
        check_folder(self.out)


def words(text: str) -> tuple[str, ...]:
    """Splits a text at its commas."""
    return tuple(word.strip() for word in text.split(",") if word.strip())


def parse_sweeps(given: Iterable[str], settings: Iterable[str]) -> dict[str, list[Any]]:
    """Reads `NAME=A,B` words of --sweep: the values to try of each setting.

    Args:
        given: the words.
        settings: names that --settings gives a value already.

    Raises:
        ValueError: a word that is not understood, a setting given twice, a value given twice.
    """
    sweeps: dict[str, list[Any]] = {}
    for word in given:
        name, separator, text = word.partition("=")
        values = [_value(part.strip()) for part in text.split(",") if part.strip()]
        if not (name and separator and values):
            raise InputError(f"--sweep takes NAME=A,B, got {word!r}")
        if name in sweeps or name in settings:
            raise InputError(f"--sweep {word}: {name} is given twice")
        if len({repr(value) for value in values}) < len(values):
            raise InputError(f"--sweep {word}: a value is given twice")
        sweeps[name] = values
    return sweeps


def parse_settings(option: str, given: Iterable[str]) -> dict[str, Any]:
    """Parses `NAME=VALUE` arguments; values that are not JSON are strings.

    Raises:
        ValueError: a word without a name or without a value; names the option.
    """
    settings: dict[str, Any] = {}
    for word in given:
        name, separator, text = word.partition("=")
        if not (name and separator):
            raise InputError(f"--{option} takes NAME=VALUE, got {word!r}")
        settings[name] = _value(text)
    return settings


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text
