"""What can go wrong with a scene file, with training data and with the machine's memory."""

from pathlib import Path


class SceneFileError(ValueError):
    """A file of Gaussians that cannot be read or written; names it and the reason."""

    def __init__(self, path: Path, reason: str):
        super().__init__(f"{path}: {reason}")
        self.path = path
        self.reason = reason


class ViewsError(ValueError):
    """Views that nothing can be trained on; says which and why."""


class TooLargeError(ValueError):
    """A training that would not fit in memory; says how much it needs and what would fit."""
