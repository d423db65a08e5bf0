"""When the views are enough: a PSNR that a forecast must reach."""

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from r3jax.apps.forecast.psnr import MEAN, percent_of

_EXAMPLE = "use psnr:25 for the mean of all views, psnr:20@p10 for all but the worst tenth"


@runtime_checkable
class PsnrForecast(Protocol):
    """What a goal asks of a forecast, which takes JAX to make."""

    def value(self, name: str) -> float:
        """A statistic of the PSNR [dB]."""
        ...


@dataclass(frozen=True)
class Goal:
    """A statistic of the PSNR of free-space views, and what it is to reach."""

    psnr: float
    """[dB]."""

    statistic: str = MEAN
    """`mean`, or a percentile: `p10`."""

    def reached(self, forecast: PsnrForecast) -> bool:
        """True if the forecast is at least as good."""
        return forecast.value(self.statistic) >= self.psnr

    def __str__(self) -> str:
        """As `parse_goal` reads it."""
        return f"psnr:{self.psnr!r}@{self.statistic}"


def parse_goal(text: str) -> Goal:
    """Reads `psnr:27` or `psnr:27@p10`.

    Raises:
        ValueError: anything else.
    """
    quantity, separator, rest = text.strip().partition(":")
    amount_text, _, name = rest.partition("@")
    if quantity != "psnr" or not separator:
        raise ValueError(f"goal {text!r} is not understood: {_EXAMPLE}")
    try:
        amount = float(amount_text)
    except ValueError:
        raise ValueError(f"goal {text!r}: {amount_text!r} is not a number; {_EXAMPLE}") from None
    if not math.isfinite(amount):
        raise ValueError(f"goal {text!r}: the PSNR must be a finite number; {_EXAMPLE}")
    name = name or MEAN
    if name != MEAN:
        try:
            percent_of(name)
        except ValueError as error:
            raise ValueError(f"goal {text!r}: {error}") from None
    return Goal(amount, name)
