"""What engines tell while cells run."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from r3jax.apps.benchmark.cells import Cell

Kind = Literal["started", "stage", "done", "failed"]


@dataclass(frozen=True)
class Event:
    """Something happened to a cell. Each cell ends with one `done` or one `failed`."""

    cell: Cell
    kind: Kind

    text: str = ""
    """The stage, or why it failed."""


Report = Callable[[Event], None]
"""Called in the process that started the engine."""
