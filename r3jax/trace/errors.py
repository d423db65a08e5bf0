"""What can go wrong with a run on disk."""

from pathlib import Path


class RunError(ValueError):
    """A run folder that cannot be read or written; names the file and the reason."""

    def __init__(self, path: Path, reason: str):
        super().__init__(f"{path}: {reason}")
        self.path = path
        self.reason = reason


class RecordingStopped(RunError):
    """The disk refused a write in the middle of a run; everything before it stays readable."""
