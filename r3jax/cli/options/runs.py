"""The options of the commands that read a run."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from r3jax.cli.options.groups import check_folder, check_folder_name, check_run
from r3jax.errors import InputError
from r3jax.formats.errors import check_capture


@dataclass(frozen=True)
class InfoOptions:
    """List scenes, policies and versions; or show a run or a recording, given its folder.

    For example
        r3jax info
        r3jax info runs/demo
    """

    path: Annotated[Path | None, Positional, arg(metavar="FOLDER")] = None
    """A run folder, or a recording (images/, depth/, poses.txt, K.txt)."""

    plot: Annotated[Path | None, arg(metavar="PNG")] = None
    """Plot a recording's renderability, frame by frame, into this PNG."""

    up: Literal["y", "z"] = "y"
    """Vertical axis of a recording's world."""

    voxel_size: float = 0.05
    """Voxel size for mapping a recording [m]."""

    def __post_init__(self) -> None:
        """Refuses a path that does not exist."""
        if self.path is not None:
            check_capture(self.path)


@dataclass(frozen=True)
class ReplayOptions:
    """Check a run: rebuild the map from the recorded frames and compare it with the stored one.

    For example
        r3jax replay runs/demo
    """

    path: Annotated[Path, Positional, arg(metavar="RUN")]
    """A run folder."""

    def __post_init__(self) -> None:
        """Refuses a path that is no run."""
        check_run(self.path)


@dataclass(frozen=True)
class MergeOptions:
    """Merge two runs of one scene into one data set and one map.

    For example
        r3jax merge runs/first runs/second --out runs/both
    """

    first: Annotated[Path, Positional, arg(metavar="RUN")]
    """A run folder."""

    second: Annotated[Path, Positional, arg(metavar="RUN")]
    """Another run with the same scene, sensor, voxel size and cell size."""

    out: Path | None = None
    """Folder of the merged run; by default both names joined by `+`, beside the first."""

    overwrite: bool = False
    """Overwrite an existing run at --out."""

    def __post_init__(self) -> None:
        """Refuses paths that are not two different runs."""
        for path in (self.first, self.second):
            check_run(path)
        if self.first.samefile(self.second):
            raise InputError(f"{self.first}: both runs are the same: give two different ones")


@dataclass(frozen=True)
class ForecastOptions:
    """Predict the PSNR that a model of a run's views would reach throughout the scene.

    For example
        r3jax forecast runs/demo --plot forecast.png
    """

    path: Annotated[Path, Positional, arg(metavar="RUN")]
    """A run folder."""

    calibration: Annotated[Path | None, arg(metavar="JSON")] = None
    """Your own calibration (made by `python -m experiments.forecast`); by default the built-in
    one."""

    plot: Annotated[Path | None, arg(metavar="PNG")] = None
    """Plot the forecast along the run into this PNG."""

    def __post_init__(self) -> None:
        """Refuses a path that is no run."""
        check_run(self.path)


@dataclass(frozen=True)
class ExportOptions:
    """Export a run for other programs: nerfstudio, COLMAP, or a submission to the benchmark.

    For example
        r3jax export runs/demo --out kitchen
        r3jax export runs/demo --format colmap --out kitchen-colmap
        r3jax export runs/demo --format submission --out demo.jsonl
    """

    path: Annotated[Path, Positional, arg(metavar="RUN")]
    """A run folder."""

    out: Annotated[Path, arg(metavar="FOLDER")]
    """New folder for the export (for a submission: a new file). It does not depend on the run."""

    format: Literal["nerfstudio", "colmap", "colmap-text", "submission"] = "nerfstudio"
    """`nerfstudio`: images, depth, points.ply, transforms.json. `colmap`: the same with
    sparse/0/*.bin in place of transforms.json; `colmap-text`: with *.txt. `submission`: one file of
    poses, some kB, for `r3jax benchmark --submission`."""

    def __post_init__(self) -> None:
        """Refuses a path that is not a run, and an output that exists."""
        check_run(self.path)
        if self.format == "submission":
            if self.out.exists():
                raise InputError(f"{self.out}: something is there already: give another file")
            return
        check_folder(self.out)
        if self.out.is_dir() and any(self.out.iterdir()):
            raise InputError(f"{self.out}: something is there already: give another folder")


@dataclass(frozen=True)
class ViewOptions:
    """View a run in the browser: the map over time, and the view of a camera that you drag.

    Of an audit or a capture: surfaces, pictures and splat, and details of a surface that you click.
    With --export, write the images of a run without a browser.

    For example
        r3jax view runs/demo
        r3jax view runs/audit/kitchen
        r3jax view runs/demo --export pictures --video
    """

    path: Annotated[Path, Positional, arg(metavar="FOLDER")]
    """A run folder, the folder of an audit, a capture (as for `r3jax audit`), or a splat (.ply)."""

    port: int = 8080
    """Port of the page; 0 takes any free one."""

    host: str = "127.0.0.1"
    """Address to listen on. By default the page is visible on this machine only; 0.0.0.0 makes it
    visible to everybody who can reach the machine."""

    allow: Annotated[tuple[str, ...], arg(metavar="NAME")] = ()
    """Further host names under which the page may be requested, such as that of a proxy."""

    name: Annotated[str | None, arg(metavar="MODEL")] = None
    """Name of the trained model, as given to `r3jax train`; by default `last` or the newest."""

    no_scene: bool = False
    """Do not open the recorded scene: no ground-truth image, no mesh."""

    export: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """Write images of the map, and one for every view, into a new folder."""

    video: bool = False
    """With --export: also write a video of the run (MP4)."""

    def __post_init__(self) -> None:
        """Refuses a path that cannot be shown, and --video without --export."""
        if self.is_run:
            check_run(self.path)
        else:
            if self.path.suffix.lower() != ".ply" or not self.path.is_file():
                check_capture(self.path)
            for option, value in (("--name", self.name), ("--export", self.export)):
                if value is not None:
                    raise InputError(f"{option} is for runs: {self.path} has no run.json")
        if self.name is not None:
            check_folder_name(self.name)
        if self.video and self.export is None:
            raise InputError("--video belongs to --export FOLDER")

    @property
    def is_run(self) -> bool:
        """True for a run; an audit, a capture and a splat have a page of their own."""
        return (self.path / "run.json").exists()


@dataclass(frozen=True)
class PoliciesOptions:
    """List the available policies with a one-line description and their source.

    For example
        r3jax policies
    """
