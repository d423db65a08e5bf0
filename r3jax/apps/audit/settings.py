"""Settings of an audit, which are options of `r3jax audit`, too. Its import is light."""

from dataclasses import dataclass

from r3jax.captures.settings import SurveySettings, at_least
from r3jax.errors import InputError

_MOST_VIEWS = 200
"""More would make the report too long to read."""


@dataclass(frozen=True)
class AuditSettings(SurveySettings):
    """How a capture is audited.

    Raises:
        ValueError: a setting that makes no sense; names the option.
    """

    folds: int = 8
    """Own frames are judged by a map without every N-th image, themselves among them."""

    views: int = 10
    """Further views to suggest."""

    num_places: int = 64
    """Places at which views are looked for, at most."""

    num_standpoints: int = 24
    """Places from which every surface is evaluated: the first of the others, at most."""

    seed: int = 0
    """Seed of the random views that the suggested ones are compared with."""

    def __post_init__(self) -> None:
        """Refuses what makes no sense."""
        super().__post_init__()
        at_least(self, {"folds": 2, "views": 0, "seed": 0})
        if self.views > _MOST_VIEWS:
            raise InputError(f"--views must be at most {_MOST_VIEWS}, got {self.views}")
