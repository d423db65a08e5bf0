"""Errors of scene files, training data and memory."""

from pathlib import Path

from r3jax.errors import InputError, PathError


class SceneFileError(PathError):
    """A file of Gaussians cannot be read or written; names it and the reason."""


class ViewsError(InputError):
    """Views that cannot be used for training; says which and why."""


class TooLargeError(InputError):
    """A training would not fit in memory; says how much it needs and what would fit."""


class CheckpointError(PathError):
    """A training cannot be resumed; names the folder and the reason."""


class TrainingDiverged(ArithmeticError):
    """The loss or a gradient is no longer finite; names the step."""

    def __init__(self, step: int, loss: float, folder: Path | None):
        kept = "" if folder is None else f"; the last good checkpoint stays in {folder}"
        super().__init__(
            f"training diverged in step {step}: the loss is {loss:g} or a gradient is not "
            f"finite{kept}. Lower the learning rates, or look for views with a wrong pose"
        )
        self.step = step
        self.folder = folder
