"""Settings of an audit; they are also options of `r3jax audit`. Imports nothing heavy."""

from dataclasses import dataclass

from r3jax.captures.settings import SurveySettings, at_least
from r3jax.errors import InputError

_MOST_VIEWS = 200
"""More would make the report too long to read."""


@dataclass(frozen=True)
class AuditSettings(SurveySettings):
    """Settings of an audit.

    Raises:
        ValueError: an invalid setting; names the option.
    """

    folds: int = 8
    """Folds of the cross-validation: each frame is evaluated on a map without it and every N-th
    frame."""

    views: int = 10
    """Number of further views to suggest."""

    num_places: int = 64
    """Maximum number of positions searched for views. A place larger than 20 m has proportionally
    more, of which those are searched around which most is lacking."""

    num_standpoints: int = 24
    """Maximum number of standpoints from which the surfaces are evaluated; proportionally more in
    a place larger than 20 m."""

    seed: int = 0
    """Random seed of the random views that serve as a baseline for the suggested ones."""

    def __post_init__(self) -> None:
        """Refuses invalid settings."""
        super().__post_init__()
        at_least(self, {"folds": 2, "views": 0, "seed": 0})
        if self.views > _MOST_VIEWS:
            raise InputError(f"--views must be at most {_MOST_VIEWS}, got {self.views}")
