"""The options of `r3jax select`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from r3jax.apps.select.settings import FRAMES, STAND, SelectSettings
from r3jax.cli.options.groups import check_folder
from r3jax.cli.parsing import FieldsOf
from r3jax.errors import InputError
from r3jax.files import check_own
from r3jax.formats.errors import check_capture
from r3jax.formats.ros.bags import parse_topics
from r3jax.formats.video import is_video

_TERMS = FieldsOf(
    "frames", "share", "gain", "targets", "keep", "drop_blurred", "drop_duplicates", "exact",
    "voxel_size", "max_range", "up", "max_frames", "depth_scale", "depth_along_ray", "trust_depth",
    "surfaces", "model", "hide_below", "overlap_360",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class SelectOptions:
    """Select the frames of a capture that are enough to train on, and write them as a data set.

    For example
        r3jax select scans/kitchen --frames 60
        r3jax select scans/kitchen --gain 0.9 --drop-blurred --copy
        r3jax select scans/kitchen --share 0.2 --targets camera_path.json
        r3jax select walk.mp4 --frames 200
    """

    capture: Annotated[Path, Positional, arg(metavar="CAPTURE")]
    """Everything that `r3jax audit` reads: nerfstudio's transforms.json or its folder, a COLMAP
    model, a phone's scan, a ROS bag, a scene of ScanNet, Replica-SLAM, TUM or 7-Scenes, a
    recording, or a run. Or a video without poses: --frames N sharp frames, evenly spaced by
    motion."""

    out: Path | None = None
    """Folder of the data set; by default runs/select/NAME. An earlier selection in it is
    replaced."""

    copy: bool = False
    """Copy the pictures; by default they are linked."""

    topics: Annotated[str | None, arg(metavar="NAMES")] = None
    """Topics and frames of a ROS bag, as for `r3jax audit`."""

    terms: Annotated[SelectSettings, _TERMS] = field(default_factory=SelectSettings)

    def __post_init__(self) -> None:
        """Checks the values before the capture is read."""
        parse_topics(self.topics)
        if not is_video(self.capture):
            check_capture(self.capture)
        elif self.terms != SelectSettings(frames=self.terms.frames or 1):
            raise InputError(
                f"{self.capture}: a video has no poses: give --frames N and no other setting"
            )
        if self.out is not None:
            check_folder(self.out)
            check_own(self.out, "selection", "give another --out")
        targets = self.terms.targets
        if targets not in (FRAMES, STAND) and not Path(targets).exists():
            raise InputError(
                f"--targets must be {FRAMES}, {STAND} or an existing file, got {targets}"
            )
