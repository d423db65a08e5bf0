"""How long a run may last: views, frames, seconds of the mission clock, or meters.

Views are those that a policy chose, and the one at the start; frames count those captured on
the way, too. Without captures they are the same.
"""

import math
from dataclasses import dataclass
from typing import Literal, cast, get_args

Unit = Literal["views", "frames", "seconds", "metres"]


@dataclass(frozen=True)
class Budget:
    """A limit in one unit."""

    unit: Unit
    amount: float

    def allows(self, *, views: int, frames: int, seconds: float, metres: float) -> bool:
        """True if a mission of that size lies within the budget."""
        spent = {"views": views, "frames": frames, "seconds": seconds, "metres": metres}
        return spent[self.unit] <= self.amount

    def spent_share(self, *, views: int, frames: int, seconds: float, metres: float) -> float:
        """Share of the budget that such a mission has used, in [0, 1]."""
        spent = {"views": views, "frames": frames, "seconds": seconds, "metres": metres}
        # Mapping the last image may exceed the budget: only its arrival has to lie within.
        return min(1.0, spent[self.unit] / self.amount)

    def __str__(self) -> str:
        """As `parse_budget` reads it."""
        # `:g` reads well but keeps six digits: a resumed run must get the very same limit.
        short = f"{self.amount:g}"
        return f"{self.unit}:{short if float(short) == self.amount else repr(self.amount)}"

    @property
    def shown(self) -> str:
        """As a user writes it."""
        return as_written(str(self))


def as_written(text: str) -> str:
    """Spells meters in a text as users do, where files spell them otherwise."""
    return text.replace("metres", "meters")


def parse_budget(text: str) -> Budget:
    """Reads `views:N`, `frames:N`, `seconds:S` or `meters:M`.

    Raises:
        ValueError: anything else, an amount that is not positive, views or frames not whole.
    """
    example = "use views:100, seconds:300 or meters:25; frames:100 counts those on the way as well"
    unit, separator, amount_text = text.strip().partition(":")
    if unit == "meters":
        unit = "metres"  # as recorded runs and submissions spell it
    if not separator or unit not in get_args(Unit):
        raise ValueError(f"budget {text!r} is not understood: {example}")
    try:
        amount = float(amount_text)
    except ValueError:
        raise ValueError(f"budget {text!r}: {amount_text!r} is not a number; {example}") from None
    if not (math.isfinite(amount) and amount > 0.0):
        raise ValueError(f"budget {text!r}: the amount must be positive and finite; {example}")
    if unit in ("views", "frames") and amount != int(amount):
        raise ValueError(f"budget {text!r}: {unit} are counted in whole numbers; {example}")
    return Budget(cast(Unit, unit), amount)
