"""The options of the commands that explore: `explore`, `team`, `demo`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg

from r3jax.apps.benchmark.terms import check_size
from r3jax.cli.options.groups import (
    CameraOptions,
    FolderOptions,
    WorldOptions,
    check_folder,
    check_free,
    check_policy_here,
    check_run,
    check_scene,
    refuse_others,
)
from r3jax.cli.parsing import FieldsOf, settings_for
from r3jax.errors import InputError
from r3jax.exploration.config import LEAST_PIECE, ExplorationConfig, parse_budget
from r3jax.planning.policies.foreign.commands import short_name
from r3jax.planning.robot.body import Body
from r3jax.planning.robot.motion import Motion, make_motion

DEFAULT_POLICY = "r3-pano"

_WITH_RESUME = ("resume", "budget", "until", "live", "port")
_WITH_FORK = (
    "fork", "at", "policy", "budget", "until", "name", "out", "overwrite", "candidates", "lambda1",
    "lambda2", "refine", "live", "port",
)  # fmt: skip
"""Options that make sense beside these; all others are fixed by what was recorded."""

MapAndClock = FieldsOf("voxel_size", "cell_size", "max_range", "capacity", "clock")
"""Settings of the loop that a team has."""

Loop = FieldsOf(
    *MapAndClock.names, "tiles", "until", "capture_every", "capture_rate", "gaze", "exposure",
    "blur", "plan_while_moving",
)  # fmt: skip
"""Settings of the loop for one camera."""


@dataclass(frozen=True)
class DemoOptions:
    """Explore a small embedded flat, train splats on the frames, evaluate them; takes minutes.

    For example
        r3jax demo
        r3jax demo --views 12 --iterations 500
    """

    out: Path = Path("runs")
    """Folder for runs; the demo overwrites only its subfolder `demo`."""

    views: int = 16
    """Number of views to choose; frames captured while moving are extra."""

    resolution: int = 256
    """Width and height of the images [px]."""

    train_resolution: int = 128
    """Width and height of the training images [px]."""

    iterations: int = 1000
    """Training steps."""

    def __post_init__(self) -> None:
        """Refuses values that no run or training takes."""
        parse_budget(f"views:{self.views}")
        check_size("resolution", self.resolution)
        check_size("train_resolution", self.train_resolution)
        check_folder(self.out)


@dataclass(frozen=True, kw_only=True)
class ContinueOptions:
    """Start from an existing run."""

    resume: Annotated[Path | None, arg(metavar="RUN")] = None
    """Resume an interrupted run with its own settings; a larger --budget extends it."""

    fork: Annotated[Path | None, arg(metavar="RUN")] = None
    """Start a new run from a frame of an existing one, with another --policy; the scene and the
    sensor are the run's."""

    at: Annotated[int | None, arg(metavar="FRAME")] = None
    """First frame to replace; earlier frames are reused. Frames are numbered as in trace.jsonl,
    those captured while moving included."""

    def __post_init__(self) -> None:
        """Refuses both at once, and a fork from nowhere."""
        if self.resume is not None and self.fork is not None:
            raise InputError(
                "--resume continues a run, --fork begins another one: give one of them"
            )
        if (self.at is None) != (self.fork is None):
            raise InputError("--fork RUN and --at FRAME belong together")
        for path in (self.resume, self.fork):
            if path is not None:
                check_run(path)


@dataclass(frozen=True, kw_only=True)
class MotionOptions:
    """How the camera moves: a preset, and changes to it."""

    motion: Literal["free", "ground", "gimbal", "handheld"] = "free"
    """Camera platform. `free`: flies in any direction; `ground`: a robot with a level camera at a
    fixed height; `gimbal`: a drone that cannot look far up; `handheld`: a person. The options below
    change the preset."""

    heights: Annotated[tuple[float, float] | None, arg(metavar="LOW HIGH")] = None
    """Lowest and highest camera position, relative to the start [m]."""

    heights_above: Literal["start", "world"] | None = None
    """Origin of --heights: `start`, or `world` for z = 0."""

    elevations: Annotated[tuple[float, float] | None, arg(metavar="LOW HIGH")] = None
    """Lowest and highest elevation of the viewing direction [degrees]."""

    footprint: Annotated[float | None, arg(metavar="RADIUS")] = None
    """Radius of the robot or person [m], from the floor up to the camera."""

    body: Annotated[float | None, arg(metavar="LENGTH")] = None
    """Clearance needed below the camera [m]; an alternative to --footprint."""

    speed: Annotated[float | None, arg(metavar="SPEED")] = None
    """Speed along the path [m/s]."""

    turn_rate: Annotated[float | None, arg(metavar="RATE")] = None
    """Speed of turning [degrees/s]."""

    turn_per_meter: Annotated[float | None, arg(metavar="ANGLE")] = None
    """Maximum turn per meter between two views [degrees/m]."""

    def __post_init__(self) -> None:
        """Refuses limits with which no camera can move."""
        _ = self.of_robot

    @property
    def of_robot(self) -> Motion:
        """The preset with the options that are given."""
        given = settings_for(Motion, self)
        if self.footprint is not None:
            if self.body is not None:
                raise InputError("--footprint and --body both set the clearance: give only one")
            given["body"] = Body(self.footprint)
        return make_motion(self.motion, **{k: v for k, v in given.items() if v is not None})


@dataclass(frozen=True, kw_only=True)
class PlanningOptions:
    """How a view is chosen."""

    candidates: Annotated[int | None, arg(metavar="N")] = None
    """Candidates per decision (policy's default: 100)."""

    lambda1: Annotated[float | None, arg(metavar="WEIGHT")] = None
    """Weight of a visible unexplored cell relative to a voxel with R = 0 (policy's default: 16)."""

    lambda2: Annotated[float | None, arg(metavar="WEIGHT")] = None
    """Weight of the path length relative to the utility (policy's default: 0.5)."""

    refine: Annotated[int | None, arg(metavar="N")] = None
    """Refine the best N candidates of `r3` or `r3-pano` by gradient ascent (0: none)."""


@dataclass(frozen=True, kw_only=True)
class PageOptions:
    """A page that shows the exploration."""

    live: bool = False
    """Show the exploration in the browser while it runs, on this machine only (extra `viewer`)."""

    port: int = 8080
    """Port of the page that --live shows; 0 takes any free one."""


@dataclass(frozen=True, kw_only=True)
class ExploreOptions:
    """Explore a scene: choose every view, record images, depth and poses, and write a report.

    For example
        r3jax explore --scene flat --budget views:50
        r3jax explore --scene mesh:house.glb --policy frontier --live
        r3jax explore --resume runs/flat-r3-pano-seed0 --budget views:100
    """

    scene: Annotated[str | None, arg(metavar="SCENE")] = None
    """Embedded scene by name (`r3jax info` lists them), `mesh:<file>` (GLB, PLY, OBJ),
    `replica:<name>`, or `habitat:<file>` (GLB, PLY, stage config)."""

    policy: Annotated[str | None, arg(metavar="POLICY")] = None
    """Policy that chooses the views: `r3-pano` by default; `r3jax policies` lists them. Your own is
    `module:Class`, or `exec:COMMAND` for a program in any language."""

    budget: Annotated[str | None, arg(metavar="BUDGET")] = None
    """When to stop: `views:N` (100 by default), `seconds:S` of the mission clock, `meters:M` of
    path, or `frames:N` including those captured while moving."""

    seed: int = 0
    """Random seed."""

    fixed_capacity: bool = False
    """Never enlarge the map's table (--capacity rows): voxels beyond it are dropped, counted and
    reported."""

    earlier: Annotated[ContinueOptions, arg(name="resume and fork")] = field(
        default_factory=ContinueOptions
    )
    folder: FolderOptions = field(default_factory=FolderOptions)
    camera: CameraOptions = field(default_factory=CameraOptions)
    robot: Annotated[MotionOptions, arg(name="motion")] = field(default_factory=MotionOptions)
    loop: Annotated[ExplorationConfig, arg(name="map and exploration"), Loop] = field(
        default_factory=ExplorationConfig
    )
    planning: PlanningOptions = field(default_factory=PlanningOptions)
    world: Annotated[WorldOptions, arg(name="scene")] = field(default_factory=WorldOptions)
    page: Annotated[PageOptions, arg(name="live page")] = field(default_factory=PageOptions)

    @property
    def changes_policy(self) -> bool:
        """True if a fork uses another policy or other settings than the original run."""
        return self.policy is not None or self.planning != PlanningOptions()

    def path(self, policy: str) -> Path:
        """Returns the folder of a new run of the scene with a policy."""
        kind, colon, rest = (self.scene or "").partition(":")
        stem = Path(rest).stem if colon else kind
        if kind == "habitat" and colon:
            stem = f"habitat-{stem.removesuffix('.stage_config')}"
        motion = "" if self.robot.motion == "free" else f"-{self.robot.motion}"
        name = f"{stem}-{short_name(policy)}{motion}-seed{self.seed}"
        return self.folder.out / (self.folder.name or name)

    def __post_init__(self) -> None:
        """Checks the values before JAX is imported and the scene is opened."""
        if self.earlier.resume is not None:
            refuse_others(self, "--resume", "recorded run", _WITH_RESUME)
        elif self.earlier.fork is not None:
            refuse_others(self, "--fork", "recorded run", _WITH_FORK)
        elif self.scene is None:
            raise InputError("give a --scene, or --resume RUN; `r3jax info` lists the scenes")
        else:
            check_scene(self.scene, self.world.scale)
            check_free(self.path(self.policy or DEFAULT_POLICY), self.folder.overwrite)
        if self.policy is not None:
            check_policy_here(self.policy)
        if self.budget is not None:
            parse_budget(self.budget)
        if not 0 <= self.seed < 1 << 32:
            raise InputError(f"--seed must lie between 0 and 2^32 - 1, got {self.seed}")
        if self.loop.until is not None:
            from r3jax.apps.forecast.psnr import parse_goal  # imports NumPy

            parse_goal(self.loop.until)
        self.loop.check_scales()
        self._check_captures()

    def _check_captures(self) -> None:
        """Refuses settings of captures that would be ignored or could not be met."""
        loop, default = self.loop, ExplorationConfig()
        for name in ("gaze", "exposure", "blur"):
            if getattr(loop, name) != getattr(default, name) and not loop.captures:
                raise InputError(
                    f"--{name} is for frames captured while moving: add --capture-every or "
                    "--capture-rate, or leave it out"
                )
        if loop.blur != default.blur and loop.exposure == 0.0:
            raise InputError(
                "--blur has no effect without --exposure: add --exposure, or leave --blur out"
            )
        largest = (self.robot.of_robot.speed or loop.speed) / LEAST_PIECE
        if loop.capture_rate is not None and loop.capture_rate > largest * (1.0 + 1e-9):
            raise InputError(
                f"--capture-rate must be at most {largest:g} Hz at this speed, one frame every "
                f"{LEAST_PIECE:g} m, got {loop.capture_rate:g}"
            )


@dataclass(frozen=True, kw_only=True)
class TeamOptions:
    """Explore a scene with several cameras at once that share their maps.

    For example
        r3jax team --scene office --cameras 3 --budget seconds:120
        r3jax team --resume runs/office-team3-seed0 --budget seconds:240
    """

    scene: Annotated[str | None, arg(metavar="SCENE")] = None
    """Embedded scene by name (`r3jax info` lists them), `mesh:<file>` (GLB, PLY, OBJ),
    `replica:<name>`, or `habitat:<file>` (GLB, PLY, stage config)."""

    cameras: int = 2
    """Number of cameras."""

    policy: tuple[str, ...] = (DEFAULT_POLICY,)
    """Policy of each camera; one for all, or one for each."""

    fov: tuple[float, ...] = (60.0,)
    """Fields of view [degrees]; one for all, or one for each."""

    resolution: tuple[int, ...] = (512,)
    """Widths and heights of the images [px]; one for all, or one for each."""

    noise: float = 0.01
    """Standard deviation of the depth noise as a share of the depth."""

    budget: Annotated[str | None, arg(metavar="BUDGET")] = None
    """When each camera stops: `seconds:S` of its mission clock (120 by default), `views:N`,
    `meters:M`."""

    meet_every: float = 0.0
    """Seconds of the mission clock between exchanges of frames; 0: always connected."""

    resume: Annotated[Path | None, arg(metavar="TEAM")] = None
    """Resume an interrupted team with its own settings; a larger --budget extends it."""

    candidates: Annotated[int | None, arg(metavar="N")] = None
    """Candidates per decision (policy's default: 100)."""

    seed: int = 0
    """Random seed."""

    folder: FolderOptions = field(default_factory=FolderOptions)
    loop: Annotated[ExplorationConfig, arg(name="map and exploration"), MapAndClock] = field(
        default_factory=ExplorationConfig
    )
    world: Annotated[WorldOptions, arg(name="scene")] = field(default_factory=WorldOptions)

    @property
    def path(self) -> Path:
        """The folder of a new team."""
        kind, _, rest = (self.scene or "").partition(":")
        name = f"{Path(rest or kind).stem}-team{self.cameras}-seed{self.seed}"
        return self.folder.out / (self.folder.name or name)

    def singles(self) -> list[ExploreOptions]:
        """Returns the options of each camera as if it flew alone.

        Raises:
            ValueError: neither one value for all cameras nor one for each, or one that a camera
                alone could not have.
        """
        if not 1 <= self.cameras <= 16:
            raise InputError(f"--cameras must lie between 1 and 16, got {self.cameras}")
        for name in ("policy", "fov", "resolution"):
            num = len(getattr(self, name))
            if num not in (1, self.cameras):
                raise InputError(
                    f"--{name} takes one value for all {self.cameras} cameras or one for each, "
                    f"got {num}"
                )
        return [
            ExploreOptions(
                scene=self.scene,
                policy=self.policy[number % len(self.policy)],
                budget=self.budget or "seconds:120",
                seed=self.seed,
                folder=FolderOptions(
                    name=str(number), out=self.path, overwrite=self.folder.overwrite
                ),
                camera=CameraOptions(
                    resolution=self.resolution[number % len(self.resolution)],
                    fov=self.fov[number % len(self.fov)],
                    noise=self.noise,
                ),
                loop=self.loop,
                planning=PlanningOptions(candidates=self.candidates),
                world=self.world,
            )
            for number in range(self.cameras)
        ]

    def __post_init__(self) -> None:
        """Checks the values before JAX is imported and the scene is opened."""
        if self.resume is not None:
            if self.budget is not None:
                parse_budget(self.budget)
            refuse_others(self, "--resume", "recorded run", ("resume", "budget"))
            check_run(self.resume / "0")
            return
        if self.scene is None:
            raise InputError("give a --scene, or --resume TEAM; `r3jax info` lists the scenes")
        if not self.meet_every >= 0.0:
            raise InputError(f"--meet-every must be a time >= 0 [s], got {self.meet_every}")
        _ = self.singles()
