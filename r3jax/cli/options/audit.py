"""The options of `r3jax audit`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import tyro

from r3jax.cli.options.bags import BagOptions


@dataclass(frozen=True, kw_only=True)
class AuditTermOptions(BagOptions):
    """How the capture is judged."""

    TITLE: ClassVar[str] = "terms"

    voxel_size: Annotated[float | None, tyro.conf.arg(metavar="LENGTH")] = None
    """Edge of a voxel in the capture's units; by default 5 cm, or from the depths."""

    max_range: Annotated[float | None, tyro.conf.arg(metavar="LENGTH")] = None
    """Surfaces farther from a camera count as invisible, in the capture's units; by default 5 m,
    or from the depths."""

    up: Annotated[str | None, tyro.conf.arg(metavar="DIRECTION")] = None
    """Direction of the capture that points up: x, y, z, -x, -y or -z (`--up=-y`), or three numbers
    (`--up=0.1,-0.9,0.4`). By default as the format says, or a guess from floors, walls and how the
    cameras were held."""

    max_frames: int = 400
    """Images to use at most, evenly spread."""

    folds: int = 8
    """Own frames are judged by a map without every N-th image, themselves among them."""

    depth_scale: Annotated[float, tyro.conf.arg(metavar="FACTOR")] = 1.0
    """Multiply all depths of depth images, where their unit is not the one that was read."""

    depth_along_ray: bool = False
    """Depth images hold the distance along each pixel's ray, as those of Hypersim and SceneNet do,
    and not z: convert it."""

    trust_depth: bool = False
    """Take the depth images as they are, even if they contradict the poses or each other."""

    seed: int = 0
    """Seed of the random views that the suggested ones are compared with."""


@dataclass(frozen=True, kw_only=True)
class GuideOptions:
    """A page that says where to go next, while the capture is being taken."""

    TITLE: ClassVar[str] = "guidance while scanning"

    live: bool = False
    """Follow a folder or ROS bag that another program is writing: the page in the browser shows
    what is done and where to go next. Ctrl-C ends it, with an audit of what came in."""

    port: int = 8080
    """Port of the page that --live shows; 0 takes any free one."""

    host: str = "127.0.0.1"
    """Address that --live listens at. By default nobody but this machine can see the page; 0.0.0.0
    shows it to everybody who can reach the machine, such as a phone."""


@dataclass(frozen=True)
class AuditOptions(GuideOptions, AuditTermOptions):
    """Audit a capture: what it lacks for splats, how frames would render, which views to add."""

    EXAMPLES: ClassVar[tuple[str, ...]] = (
        "r3jax audit scans/kitchen",
        "r3jax audit scans/kitchen --live --host 0.0.0.0",
        "r3jax audit scans/kitchen/transforms.json --path camera_path.json --views 20",
    )

    capture: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURE")]
    """A phone's scan as the app shares it, a ROS bag, nerfstudio's transforms.json or its folder, a
    COLMAP model, a scene of ScanNet, Replica-SLAM, TUM or 7-Scenes, a recording (images/, depth/,
    poses.txt, K.txt), or a run."""

    path: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Camera path to judge, in the capture's coordinates: nerfstudio's camera_path.json, or any
    capture. By default the capture's own frames, each judged without itself."""

    views: int = 10
    """Further views to suggest."""

    out: Path | None = None
    """Folder of the audit; by default runs/audit/NAME. An earlier audit in it is replaced."""
