"""The options of `r3jax audit`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from r3jax.apps.audit.settings import AuditSettings
from r3jax.cli.options.groups import check_folder
from r3jax.cli.parsing import FieldsOf
from r3jax.errors import InputError
from r3jax.files import check_own
from r3jax.formats.errors import check_capture
from r3jax.formats.ros.bags import parse_topics

_GROWING = (".json", ".mcap", ".db3", ".bag", ".active")
"""Suffixes of files that can grow; the reader explains why some of them cannot be followed."""

_TERMS = FieldsOf(
    "views", "voxel_size", "max_range", "up", "max_frames", "folds", "seed", "depth_scale",
    "depth_along_ray", "trust_depth", "surfaces", "model", "hide_below", "overlap_360",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class GuideOptions:
    """A page with guidance while you scan."""

    live: bool = False
    """Follow a folder or ROS bag that another program is writing: a page in the browser shows the
    progress and where to go next. Ctrl-C ends it with an audit of the received frames."""

    port: int = 8080
    """Port of the page that --live shows; 0 takes any free one."""

    host: str = "127.0.0.1"
    """Address that --live listens on. By default the page is visible on this machine only; 0.0.0.0
    makes it visible to everybody who can reach the machine, such as a phone."""

    def __post_init__(self) -> None:
        """Refuses a page that would not be shown, or could not be."""
        if not self.live and (self.port, self.host) != (GuideOptions.port, GuideOptions.host):
            raise InputError("--port and --host are for the page of --live")
        if not 0 <= self.port <= 65535:
            raise InputError(f"--port must lie between 0 and 65535, got {self.port}")


@dataclass(frozen=True, kw_only=True)
class AuditOptions:
    """Audit a capture: where its splats would fail, how well it is covered, which views to add.

    For example
        r3jax audit scans/kitchen
        r3jax audit scans/kitchen --live --host 0.0.0.0
        r3jax audit scans/kitchen/transforms.json --path camera_path.json --views 20
    """

    capture: Annotated[Path, Positional, arg(metavar="CAPTURE")]
    """A phone's scan as the app shares it, a ROS bag, nerfstudio's transforms.json or its folder, a
    COLMAP model, a scene of ScanNet, Replica-SLAM, TUM or 7-Scenes, a recording (images/, depth/,
    poses.txt, K.txt), or a run."""

    path: Annotated[Path | None, arg(metavar="FILE")] = None
    """Camera path to evaluate, in the capture's coordinates: nerfstudio's camera_path.json, or any
    capture. By default the capture's own frames, each left out in turn."""

    out: Path | None = None
    """Output folder; by default runs/audit/NAME. An earlier audit in it is replaced."""

    topics: Annotated[str | None, arg(metavar="NAMES")] = None
    """Topics and frames of a ROS bag, such as color=/cam/image_raw,pose=/odom; also depth, info,
    depth_info, frame, world. By default they are detected."""

    preview: bool = False
    """Train a splat on small images, too, in two to three minutes: `r3jax view` shows it beside the
    surfaces."""

    terms: Annotated[AuditSettings, _TERMS] = field(default_factory=AuditSettings)
    guide: Annotated[GuideOptions, arg(name="guidance while scanning")] = field(
        default_factory=GuideOptions
    )

    def __post_init__(self) -> None:
        """Checks the values before the capture is read."""
        parse_topics(self.topics)
        if self.guide.live:
            _check_live(self.capture)
            if self.path is not None:
                raise InputError(
                    "--live follows a capture, --path needs a finished one: give one of them"
                )
            if self.terms.depth_scale != 1.0 or self.terms.depth_along_ray:
                raise InputError(
                    "--depth-scale and --depth-along-ray cannot be used with --live: audit the "
                    "capture with them once it is finished"
                )
        else:
            check_capture(self.capture)
        if self.out is not None:
            check_folder(self.out)
            check_own(self.out, "audit", "give another --out")
        if self.path is not None and not self.path.exists():
            raise InputError(f"{self.path}: there is no such folder or file")


def _check_live(path: Path) -> None:
    """Refuses a finished file, and a path that can never be recorded, such as a topic's name.

    Raises:
        ValueError: says what can be followed.
    """
    if path.is_file() and path.suffix not in _GROWING:
        raise InputError(
            f"{path}: --live needs a growing recording; drop --live for a finished file"
        )
    if path.exists() or path.absolute().parent.is_dir():
        return
    raise InputError(
        f"{path}: there is no such capture, and no folder in which it could be recorded. Topics of "
        "a running ROS 2 are followed by the node, which shows the same page: ros2 run "
        f"r3jax_ros explorer --ros-args -p page_port:=8080 -r color:={path} -r depth:=... -r "
        "camera_info:=...; or follow a bag: ros2 bag record -o drive --storage mcap TOPICS, and "
        "r3jax audit drive --live"
    )
