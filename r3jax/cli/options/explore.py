"""The options of the commands that explore."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class Demo:
    """Explore a small embedded flat, train splats on the views, judge them; takes minutes."""

    out: Path = Path("runs")
    """Folder that holds the runs; the demo overwrites `demo` in it and nothing else."""

    views: int = 24
    """Views to take."""

    resolution: int = 256
    """Width and height of the images [px]."""

    train_resolution: int = 128
    """Width and height of the images that are trained on [px]."""

    iterations: int = 1000
    """Steps of the training."""


@dataclass(frozen=True)
class Explore:
    """Explore a scene: choose every view, record images, depth, poses, and write a report."""

    scene: Annotated[str | None, tyro.conf.arg(metavar="SCENE")] = None
    """Embedded scene by name, or `mesh:<file>` (GLB, PLY, OBJ); `r3jax info` lists them."""

    policy: Annotated[str | None, tyro.conf.arg(metavar="POLICY")] = None
    """Who chooses the next view: `ours-pano` by default; `r3jax policies` lists them."""

    budget: Annotated[str | None, tyro.conf.arg(metavar="BUDGET")] = None
    """When to stop: `views:N` (100 by default), `seconds:S` of the mission clock, `metres:M`."""

    until: Annotated[str | None, tyro.conf.arg(metavar="GOAL")] = None
    """Stop before the budget is spent, when the forecast of the image quality says that the views
    are enough: `psnr:25` for the mean of all free-space views, `psnr:20@p10` for all but the worst
    tenth."""

    resume: Annotated[Path | None, tyro.conf.arg(metavar="RUN")] = None
    """Go on with a run that was cut off; all settings are its own. Another --budget extends it."""

    fork: Annotated[Path | None, tyro.conf.arg(metavar="RUN")] = None
    """Try another --policy from a view of a run on; the scene and the sensor are the run's."""

    at: Annotated[int | None, tyro.conf.arg(metavar="VIEW")] = None
    """Number of the view that the fork takes anew; those before it are kept."""

    name: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Name of the run; by default made of scene, policy and seed."""

    out: Path = Path("runs")
    """Folder that holds the runs."""

    overwrite: bool = False
    """Replace the run of that name if there is one."""

    seed: int = 0
    """All randomness follows from it."""

    clock: Literal["wall", "model"] = "wall"
    """`wall`: measured planning and mapping + flight. `model`: fixed costs, repeatable."""

    resolution: int = 512
    """Width and height of the images [px]."""

    fov: float = 60.0
    """Field of view [degrees]."""

    up: Literal["y", "z"] | None = None
    """Vertical axis of a mesh file; by default y for GLB and glTF, z for the others."""

    scale: float = 1.0
    """Metres in a unit of a mesh file: 0.001 for one in millimeters."""

    cull_backfaces: bool = False
    """Look through faces seen from behind, as Habitat-Sim always does."""

    noise: float = 0.01
    """Standard deviation of the depth noise as a share of the depth."""

    max_range: float = 5.0
    """Range of the depth sensor [m]."""

    start: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y Z")] = None
    """Start position in the z-up world [m]; by default the scene's own, or a search."""

    motion: Literal["free", "ground", "gimbal", "handheld"] = "free"
    """What carries the camera: `free`: a camera that flies; `ground`: a robot whose camera is level
    and at the height where it starts; `gimbal`: a drone that cannot look up far; `handheld`: a
    person. The options below change it."""

    heights: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="LOW HIGH")] = None
    """Lowest and highest place of the camera, above the start [m]."""

    heights_above: Annotated[Literal["start", "world"] | None, tyro.conf.arg()] = None
    """What --heights count from: `start`, or `world` for z = 0."""

    elevations: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="LOW HIGH")] = None
    """Lowest and highest angle of the line of sight above the horizon [degrees]."""

    body: Annotated[float | None, tyro.conf.arg(metavar="LENGTH")] = None
    """So far below the camera nothing may be in the way of what carries it [m]."""

    speed: Annotated[float | None, tyro.conf.arg(metavar="SPEED")] = None
    """Along the way [m/s]."""

    turn_rate: Annotated[float | None, tyro.conf.arg(metavar="RATE")] = None
    """How fast the line of sight turns [degrees/s]."""

    turn_per_meter: Annotated[float | None, tyro.conf.arg(metavar="ANGLE")] = None
    """Largest turn for each meter between a view and the next [degrees/m]."""

    voxel_size: float = 0.05
    """Edge of a voxel of the map [m]."""

    cell_size: float = 0.2
    """Edge of a cell of the coarse grid [m]."""

    capacity: Annotated[int, tyro.conf.arg(metavar="ROWS")] = 1 << 17
    """Rows of the map at the start, a power of two; a map that may grow has 16384 at least."""

    fixed_capacity: bool = False
    """Never grow the map: what finds no row is counted as dropped and reported."""

    candidates: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Candidates per decision (policy's default: 100)."""

    lambda1: Annotated[float | None, tyro.conf.arg(metavar="WEIGHT")] = None
    """Weight of a visible unexplored cell against a voxel that renders badly."""

    lambda2: Annotated[float | None, tyro.conf.arg(metavar="WEIGHT")] = None
    """Weight of the path length against the utility (policy's default: 0.5)."""

    refine: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """The best N candidates of `ours` and its kin climb the utility by its gradient (0: none)."""

    live: bool = False
    """Show the exploration in the browser while it runs, on this machine only (extra `viewer`)."""

    port: int = 8080
    """Port of the page that --live shows; 0 takes any free one."""
