"""What can go wrong with somebody else's files."""

from pathlib import Path


class FormatError(ValueError):
    """A file or folder that cannot be read; names it and the reason."""

    def __init__(self, path: Path, reason: str):
        super().__init__(f"{path}: {reason}")
        self.path = path
        self.reason = reason
