"""What can be trained on or judged: a run, or a recording, opened in the same way."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from r3jax.cli.errors import UserError
from r3jax.formats.recordings import Recording, is_recording, read_recording
from r3jax.frame import Frame
from r3jax.trace.reader import Run, read_run


@dataclass(frozen=True)
class Capture:
    """Posed RGB-D frames on disk."""

    path: Path
    source: Run | Recording

    @property
    def run(self) -> Run | None:
        """The run, if it is one."""
        return self.source if isinstance(self.source, Run) else None

    def __len__(self) -> int:
        return len(self.source.rows if isinstance(self.source, Run) else self.source)

    def frames(self) -> Iterator[Frame]:
        """Every frame in order, read one by one."""
        return self.source.frames()

    @property
    def models(self) -> Path:
        """Folder of the models; a recording is somebody else's and stays untouched."""
        if self.run is not None:
            return self.path / "models"
        return Path("runs") / self.path.resolve().name / "models"


def open_capture(path: Path, up: Literal["y", "z"] = "y") -> Capture:
    """Opens a run folder or a recording.

    Raises:
        UserError: the folder is neither.
        RunError, FormatError: it is one, but broken.
    """
    if (path / "run.json").exists():
        return Capture(path, read_run(path))
    if is_recording(path):
        return Capture(path, read_recording(path, up))
    if not path.is_dir():
        raise UserError(f"{path}: there is no such folder")
    raise UserError(f"{path}: neither a run (no run.json) nor a recording (no poses.txt, images/)")
