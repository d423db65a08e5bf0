"""The options of every command. Light on purpose: `--help` must not wait for JAX."""

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

    noise: float = 0.01
    """Standard deviation of the depth noise as a share of the depth."""

    max_range: float = 5.0
    """Range of the depth sensor [m]."""

    start: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y Z")] = None
    """Start position in the z-up world [m]; by default the scene's own, or a search."""

    voxel_size: float = 0.05
    """Edge of a voxel of the map [m]."""

    cell_size: float = 0.2
    """Edge of a cell of the coarse grid [m]."""

    capacity: Annotated[int, tyro.conf.arg(metavar="ROWS")] = 1 << 17
    """Rows of the map at the start, a power of two."""

    fixed_capacity: bool = False
    """Never grow the map: what finds no row is counted as dropped and reported."""

    candidates: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Candidates per decision (policy's default: 100)."""

    lambda1: Annotated[float | None, tyro.conf.arg(metavar="WEIGHT")] = None
    """Weight of a visible unexplored cell against a voxel that renders badly."""

    lambda2: Annotated[float | None, tyro.conf.arg(metavar="WEIGHT")] = None
    """Weight of the path length against the utility (policy's default: 0.5)."""

    live: bool = False
    """Show the exploration in the browser while it runs, on this machine only (extra `viewer`)."""

    port: int = 8080
    """Port of the page that --live shows; 0 takes any free one."""


@dataclass(frozen=True)
class Info:
    """List scenes, policies and versions; or show a run or a recording, given its folder."""

    path: Annotated[Path | None, tyro.conf.Positional] = None
    """A run folder, or a recording (images/, depth/, poses.txt, K.txt)."""

    plot: Annotated[Path | None, tyro.conf.arg(metavar="PNG")] = None
    """PNG for a recording's renderability, frame by frame."""

    up: Literal["y", "z"] = "y"
    """Axis of a recording's world that points up."""

    voxel_size: float = 0.05
    """Edge of a voxel when a recording is mapped [m]."""


@dataclass(frozen=True)
class Replay:
    """Rebuild the map of a run from its recorded frames, and compare it with the stored one."""

    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """A run folder."""


@dataclass(frozen=True)
class Merge:
    """Merge two runs of one scene: their frames in one data set, and the map that saw both."""

    first: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """A run folder."""

    second: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Another one: the same scene, sensor, voxels and cells."""

    out: Path | None = None
    """Folder of the merged run; by default both names joined by `+`, beside the first."""

    overwrite: bool = False
    """Replace the run that is there."""


@dataclass(frozen=True)
class Export:
    """Export a run for other programs: nerfstudio's transforms.json, or a COLMAP model."""

    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """A run folder."""

    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")]
    """Where to: a folder that does not exist yet. It needs the run no longer."""

    format: Literal["nerfstudio", "colmap", "colmap-text"] = "nerfstudio"
    """`nerfstudio`: images, depth, points.ply, transforms.json. `colmap`: the same with
    sparse/0/*.bin in place of transforms.json; `colmap-text`: with *.txt."""


@dataclass(frozen=True)
class Audit:
    """Audit a capture: what it lacks for splats, how frames would render, which views to add."""

    capture: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURE")]
    """nerfstudio's transforms.json or its folder, a COLMAP model, a scene of Replica-SLAM, TUM or
    7-Scenes, a recording (images/, depth/, poses.txt, K.txt), or a run."""

    path: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Camera path to judge, in the capture's coordinates: nerfstudio's camera_path.json, or any
    capture. By default the capture's own frames, each judged without itself."""

    views: int = 10
    """Further views to suggest."""

    out: Path | None = None
    """Folder of the audit; by default runs/audit/NAME. An earlier audit in it is replaced."""

    voxel_size: Annotated[float | None, tyro.conf.arg(metavar="LENGTH")] = None
    """Edge of a voxel in the capture's units; by default 5 cm, or from the depths."""

    max_range: Annotated[float | None, tyro.conf.arg(metavar="LENGTH")] = None
    """Surfaces farther from a camera count as invisible, in the capture's units; by default 5 m,
    or from the depths."""

    up: Literal["x", "y", "z", "-x", "-y", "-z"] | None = None
    """Axis of the capture that points up (`--up=-y` where it points down); by default as its
    cameras were held."""

    max_frames: int = 400
    """Pictures to use at most, evenly spread."""

    folds: int = 8
    """Own frames are judged by a map without every N-th picture, themselves among them."""

    seed: int = 0
    """Of the random views that the suggested ones are compared with."""


@dataclass(frozen=True)
class View:
    """Look at a run in the browser: the map over time, and what a camera that you drag would see.

    Or, with --export, write the pictures without a browser.
    """

    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """A run folder."""

    port: int = 8080
    """Port of the page; 0 takes any free one."""

    host: str = "127.0.0.1"
    """Address to listen at. By default nobody but this machine can see the page; 0.0.0.0 shows it
    to everybody who can reach the machine."""

    name: Annotated[str | None, tyro.conf.arg(metavar="MODEL")] = None
    """Name of the trained model, as given to `r3jax train`; by default `last` or the newest."""

    no_scene: bool = False
    """Do not open the scene that the run was recorded in: no true image, no mesh."""

    export: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Write pictures of the map and one for every view into a folder that does not exist yet."""

    video: bool = False
    """With --export: a film of the run too (MP4)."""


@dataclass(frozen=True)
class Policies:
    """List who can choose views: every policy in a sentence, and where its rule comes from."""


@dataclass(frozen=True)
class Train:
    """Train 3D Gaussian splatting from scratch on a run or a recording."""

    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """A run folder, or a recording (images/, depth/, poses.txt, K.txt)."""

    iterations: int = 7000
    """Steps of the optimizer; schedules shrink with it."""

    resolution: int | None = None
    """Longer side of the training images [px]; by default as recorded."""

    strategy: Literal["vanilla", "mcmc"] = "vanilla"
    """`vanilla`: clone, split, prune, reset. `mcmc`: relocation and noise within a fixed budget."""

    gaussians: int = 50_000
    """Gaussians at the start, on the recorded surfaces."""

    capacity: int | None = None
    """Gaussians that there may ever be; by default twice those of the start."""

    hold_out: int = 8
    """Keep every N-th view for `r3jax evaluate`; 0 trains on all."""

    name: str = "last"
    """Name of the model."""

    out: Path | None = None
    """Folder that holds the models; by default RUN/models, for a recording runs/NAME/models."""

    overwrite: bool = False
    """Replace the model of that name if there is one."""

    resume: bool = False
    """Go on from the newest checkpoint of that model; the result is the same as without a break."""

    seed: int = 0
    """All randomness follows from it."""

    views_per_step: int = 1
    """Views whose losses are averaged for one step."""

    background: Literal["black", "white", "random"] = "black"
    """Behind everything."""

    backend: Literal["auto", "numba", "xla", "splax"] = "auto"
    """Rasteriser: numba on CPUs, splax on NVIDIA GPUs if installed, xla elsewhere."""

    up: Literal["y", "z"] = "y"
    """Axis of a recording's world that points up."""


@dataclass(frozen=True)
class Evaluate:
    """Judge a model by test views: PSNR, SSIM, LPIPS, their tails, and the worst views."""

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

    worst: int = 8
    """Views on the contact sheet; 0 draws none."""

    out: Path | None = None
    """Folder for the results; by default RUN/report, for a recording the model's folder."""

    rows: Literal["csv", "parquet"] = "csv"
    """Kind of the file with one row per view."""

    no_renderability: bool = False
    """Do not map the training views to set the map's expectation beside the result."""

    seed: int = 0
    """Of the bootstrap."""

    backend: Literal["auto", "numba", "xla", "splax"] = "auto"
    """Rasteriser: numba on CPUs, splax on NVIDIA GPUs if installed, xla elsewhere."""

    up: Literal["y", "z"] = "y"
    """Axis of a recording's world that points up."""


@dataclass(frozen=True)
class Benchmark:
    """Compare policies on equal terms: explore, train and judge scenes x policies x seeds."""

    scenes: Annotated[str, tyro.conf.arg(metavar="A,B")] = "flat,office"
    """Embedded scenes by name, or `mesh:<file>`, with commas between."""

    policies: Annotated[str, tyro.conf.arg(metavar="A,B")] = "ours,ours-pano,frontier,random"
    """Who chooses the views, with commas between."""

    seeds: Annotated[str, tyro.conf.arg(metavar="0,1")] = "0"
    """Each makes an exploration and a training of its own."""

    budget: Annotated[str, tyro.conf.arg(metavar="BUDGET")] = "views:60"
    """Of every exploration: `views:N`, `seconds:S` of the mission clock, or `metres:M`."""

    snapshots: Annotated[str | None, tyro.conf.arg(metavar="A,B")] = None
    """Where a model is trained and judged, for example `views:30,views:60`; by default at the
    budget."""

    out: Path = Path("runs/benchmark")
    """Folder of the results. What is done in it is not done again; an interrupted benchmark
    goes on when it is started again with the same words."""

    clock: Literal["wall", "model"] = "wall"
    """`wall`: measured planning and mapping + flight. `model`: fixed costs, repeatable."""

    resolution: int = 256
    """Width and height of the explored images [px]."""

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

    settings: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """Settings of all policies: `num_candidates=50`, `lambda2=0.3`, `scoring.lambda1=8`, ..."""

    voxel_size: float = 0.05
    """Edge of a voxel of the map [m]."""

    max_range: float = 5.0
    """Range of the depth sensor [m]."""

    noise: float = 0.01
    """Standard deviation of the explored depth as a share of the depth; test views have none."""

    fov: float = 60.0
    """Field of view [degrees]."""

    up: Literal["y", "z"] | None = None
    """Vertical axis of mesh files; by default y for GLB and glTF, z for the others."""

    backend: Literal["auto", "numba", "xla", "splax"] = "auto"
    """Rasteriser: numba on CPUs, splax on NVIDIA GPUs if installed, xla elsewhere."""

    engine: Literal["local", "slurm"] = "local"
    """`local`: processes on this machine, one GPU each where there are several. `slurm`: an array
    job, pre-emption safe."""

    jobs: int = 1
    """Cells at a time; 0: one by one in this very process, for debugging."""

    slurm: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """Parameters of the array job, as submitit calls them: `timeout_min=240`,
    `slurm_partition=gpu`, `gpus_per_node=1`, ..."""
