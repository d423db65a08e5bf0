"""The options of the commands that explore with one camera."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import tyro

from r3jax.cli.options.groups import (
    DepthOptions,
    FolderOptions,
    MapOptions,
    RepeatOptions,
    SceneOptions,
)


@dataclass(frozen=True)
class DemoOptions:
    """Explore a small embedded flat, train splats on the frames, judge them; takes minutes."""

    EXAMPLES: ClassVar[tuple[str, ...]] = ("r3jax demo", "r3jax demo --views 12 --iterations 500")

    out: Path = Path("runs")
    """Folder that holds the runs; the demo overwrites `demo` in it and nothing else."""

    views: int = 16
    """Views to choose; frames on the way to them come on top."""

    resolution: int = 256
    """Width and height of the images [px]."""

    train_resolution: int = 128
    """Width and height of the images that are trained on [px]."""

    iterations: int = 1000
    """Steps of the training."""


@dataclass(frozen=True, kw_only=True)
class ContinueOptions:
    """A run that is gone on with, or left for another."""

    TITLE: ClassVar[str] = "resume and fork"

    resume: Annotated[Path | None, tyro.conf.arg(metavar="RUN")] = None
    """Go on with a run that was cut off; all settings are its own. Another --budget extends it."""

    fork: Annotated[Path | None, tyro.conf.arg(metavar="RUN")] = None
    """Try another --policy from a frame of a run on; the scene and the sensor are the run's."""

    at: Annotated[int | None, tyro.conf.arg(metavar="FRAME")] = None
    """Number of the frame that the fork takes anew; those before it are kept. Without frames on the
    way every frame is a view."""


@dataclass(frozen=True, kw_only=True)
class ImageOptions:
    """What the color camera sees."""

    TITLE: ClassVar[str] = "camera"

    resolution: int = 512
    """Width and height of the images [px]."""

    fov: float = 60.0
    """Field of view [degrees]."""


@dataclass(frozen=True, kw_only=True)
class MotionOptions:
    """What carries the camera."""

    TITLE: ClassVar[str] = "motion"

    motion: Literal["free", "ground", "gimbal", "handheld"] = "free"
    """What carries the camera: `free`: a camera that flies; `ground`: a robot whose camera is level
    and at the height where it starts; `gimbal`: a drone that cannot look up far; `handheld`: a
    person. The options below change it."""

    heights: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="LOW HIGH")] = None
    """Lowest and highest place of the camera, above the start [m]."""

    heights_above: Literal["start", "world"] | None = None
    """What --heights count from: `start`, or `world` for z = 0."""

    elevations: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="LOW HIGH")] = None
    """Lowest and highest angle of the line of sight above the horizon [degrees]."""

    body: Annotated[float | None, tyro.conf.arg(metavar="LENGTH")] = None
    """Clearance that the robot needs below the camera [m]."""

    speed: Annotated[float | None, tyro.conf.arg(metavar="SPEED")] = None
    """Speed along the path [m/s]."""

    turn_rate: Annotated[float | None, tyro.conf.arg(metavar="RATE")] = None
    """How fast the line of sight turns [degrees/s]."""

    turn_per_meter: Annotated[float | None, tyro.conf.arg(metavar="ANGLE")] = None
    """Largest turn for each meter between a view and the next [degrees/m]."""


@dataclass(frozen=True, kw_only=True)
class CaptureOptions:
    """Frames on the way from view to view."""

    TITLE: ClassVar[str] = "captures on the way"

    capture_every: Annotated[float | None, tyro.conf.arg(metavar="LENGTH")] = None
    """Capture frames on the way from view to view, at most so far apart [m]; by default none."""

    capture_rate: Annotated[float | None, tyro.conf.arg(metavar="RATE")] = None
    """The same by frames per second of the way [Hz]; none is taken while the camera turns at its
    end."""

    gaze: Literal["ahead", "panorama"] = "panorama"
    """Where the camera points while moving: `ahead`: along the path; `panorama`: at each place in
    the direction of highest utility."""

    exposure: float = 0.0
    """Time that the shutter is open for a frame on the way [s]; 0: turning blurs nothing."""

    blur: float = 1.0
    """So many pixels the image may move meanwhile by turning [px]."""

    plan_while_moving: bool = False
    """Decide on the next view during the flight, on the map as it will be, and only reconsider on
    arrival: the clock is charged for what the flight does not hide."""


@dataclass(frozen=True, kw_only=True)
class GrowthOptions(MapOptions):
    """What the map is made of, and whether it grows."""

    TITLE: ClassVar[str] = "map"

    fixed_capacity: bool = False
    """Never grow the map: what finds no row is counted as dropped and reported."""


@dataclass(frozen=True, kw_only=True)
class PlanningOptions:
    """How a view is chosen."""

    TITLE: ClassVar[str] = "planning"

    candidates: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Candidates per decision (policy's default: 100)."""

    lambda1: Annotated[float | None, tyro.conf.arg(metavar="WEIGHT")] = None
    """Weight of a visible unexplored cell against a voxel that renders badly."""

    lambda2: Annotated[float | None, tyro.conf.arg(metavar="WEIGHT")] = None
    """Weight of the path length against the utility (policy's default: 0.5)."""

    refine: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """The best N candidates of `ours` and its kin climb the utility by its gradient (0: none)."""


@dataclass(frozen=True, kw_only=True)
class PageOptions:
    """A page that shows the exploration."""

    TITLE: ClassVar[str] = "live page"

    live: bool = False
    """Show the exploration in the browser while it runs, on this machine only (extra `viewer`)."""

    port: int = 8080
    """Port of the page that --live shows; 0 takes any free one."""


@dataclass(frozen=True)
class ExploreOptions(
    ContinueOptions,
    FolderOptions,
    ImageOptions,
    DepthOptions,
    MotionOptions,
    CaptureOptions,
    PlanningOptions,
    SceneOptions,
    GrowthOptions,
    RepeatOptions,
    PageOptions,
):
    """Explore a scene: choose every view, record images, depth, poses, and write a report."""

    EXAMPLES: ClassVar[tuple[str, ...]] = (
        "r3jax explore --scene flat --budget views:50",
        "r3jax explore --scene mesh:house.glb --policy frontier --live",
        "r3jax explore --resume runs/flat-ours-pano-seed0 --budget views:100",
    )

    scene: Annotated[str | None, tyro.conf.arg(metavar="SCENE")] = None
    """Embedded scene by name (`r3jax info` lists them), `mesh:<file>` (GLB, PLY, OBJ),
    `replica:<name>`, or `habitat:<file>` (GLB, PLY, stage config)."""

    policy: Annotated[str | None, tyro.conf.arg(metavar="POLICY")] = None
    """Who chooses the next view: `ours-pano` by default; `r3jax policies` lists them. A class of
    yours is `module:Class`, a program in any language `exec:COMMAND`."""

    budget: Annotated[str | None, tyro.conf.arg(metavar="BUDGET")] = None
    """When to stop: `views:N` (100 by default), `seconds:S` of the mission clock, `meters:M`, or
    `frames:N`, those captured on the way included."""

    until: Annotated[str | None, tyro.conf.arg(metavar="GOAL")] = None
    """Stop before the budget is spent, when the forecast of the image quality says that the views
    are enough: `psnr:25` for the mean of all free-space views, `psnr:20@p10` for all but the worst
    tenth."""

    @property
    def changes_policy(self) -> bool:
        """True if a fork decides otherwise than the run that it leaves."""
        given = (self.policy, self.candidates, self.lambda1, self.lambda2, self.refine)
        return any(value is not None for value in given)
