"""Settings of the loop and its budget: plain numbers, which run.json stores."""

import math
from dataclasses import dataclass
from typing import Literal, cast, get_args

from r3jax.errors import InputError
from r3jax.mapping.config import MappingConfig
from r3jax.planning.robot.motion import LEAST_RATE

ClockName = Literal["wall", "model"]

GazeName = Literal["ahead", "panorama"]
"""Where the camera looks while moving; `planning.turning` says how each finds its directions."""

RETIRED_GAZES = {
    "blend": "it lost 1.8 dB against panorama; commit fb13156 has it",
    "planned": "it lost 0.7 dB against panorama; commit fb13156 has it",
}
"""Removed gazes that recorded runs may name: why they were removed, and the commit with their
code."""

LEAST_PIECE = 0.05
"""Minimum distance between frames captured while moving [m]: one voxel."""

DEPTH_STEPS_PER_METRE = 5000
"""Recorded depth is in steps of 0.2 mm (TUM's scale)."""

BEYOND_RANGE = 65535
"""Recorded depth where nothing lies within the sensor's range (or within 13.1 m)."""

# One step less: the largest stored value means "beyond the range", not a depth.
LARGEST_DEPTH = (BEYOND_RANGE - 1) / DEPTH_STEPS_PER_METRE
"""Largest depth that a depth image can store [m]; larger ones are recorded as beyond the range."""

Unit = Literal["views", "frames", "seconds", "metres"]


@dataclass(frozen=True)
class Budget:
    """The budget of a run.

    Views are the initial one and those that the policy chose. Frames also include those captured
    while moving. Seconds are on the mission clock.
    """

    unit: Unit
    amount: float

    def allows(self, *, views: int, frames: int, seconds: float, metres: float) -> bool:
        """Returns True if a mission of that size lies within the budget."""
        spent = {"views": views, "frames": frames, "seconds": seconds, "metres": metres}
        return spent[self.unit] <= self.amount

    def spent_share(self, *, views: int, frames: int, seconds: float, metres: float) -> float:
        """Returns the share of the budget that such a mission has used, in [0, 1]."""
        spent = {"views": views, "frames": frames, "seconds": seconds, "metres": metres}
        # Mapping the last image may exceed the budget: only its arrival has to lie within.
        return min(1.0, spent[self.unit] / self.amount)

    def __str__(self) -> str:
        """As `parse_budget` reads it."""
        # `:g` reads well but keeps six digits: a resumed run must get the very same limit.
        short = f"{self.amount:g}"
        return f"{self.unit}:{short if float(short) == self.amount else repr(self.amount)}"

    @property
    def words(self) -> str:
        """As a sentence has it: `16 views`."""
        return budget_words(str(self))


def budget_words(text: str) -> str:
    """Spells a budget as a sentence has it: `views:16` as `16 views`."""
    unit, _, amount = format_budget(text).partition(":")
    return f"{amount} {unit}".strip()


def format_budget(text: str) -> str:
    """Spells meters in a text as users do, where files spell them otherwise."""
    return text.replace("metres", "meters")


def parse_budget(text: str) -> Budget:
    """Reads `views:N`, `frames:N`, `seconds:S` or `meters:M`.

    Raises:
        ValueError: anything else, an amount that is not positive, views or frames not whole.
    """
    example = (
        "use views:100, seconds:300 or meters:25; frames:100 counts those captured while moving"
    )
    unit, separator, amount_text = text.strip().partition(":")
    if unit == "meters":
        unit = "metres"  # as recorded runs and submissions spell it
    if not separator or unit not in get_args(Unit):
        raise InputError(f"budget {text!r} is not understood: {example}")
    try:
        amount = float(amount_text)
    except ValueError:
        raise InputError(f"budget {text!r}: {amount_text!r} is not a number; {example}") from None
    if not (math.isfinite(amount) and amount > 0.0):
        raise InputError(f"budget {text!r}: the amount must be positive and finite; {example}")
    if unit in ("views", "frames") and amount != int(amount):
        raise InputError(f"budget {text!r}: {unit} are counted in whole numbers; {example}")
    return Budget(cast(Unit, unit), amount)


def check_voxel_size(voxel_size: float, max_range: float) -> None:
    """Refuses voxels too large for a useful map.

    Args:
        voxel_size: edge of a voxel [m].
        max_range: of the depth sensor [m].

    Raises:
        ValueError: they are larger than a fifth of the range.
    """
    if voxel_size > 0.2 * max_range:
        raise InputError(
            f"voxel_size must be at most a fifth of the range of {max_range:g} m, got "
            f"{voxel_size:g}"
        )


@dataclass(frozen=True)
class ExplorationConfig(MappingConfig):
    """Settings of the loop, mapping included; the policy has its own settings."""

    remove_moved: bool = False
    """Remove voxels that later frames see through. Off by default: nothing moves in simulated
    scenes, and earlier recorded runs were made without it."""

    speed: float = 1.0
    """Speed [m/s] if the policy's motion sets none; turning then takes no time."""

    clock: ClockName = "wall"
    """Mission clock. `wall`: measured planning and mapping time plus travel time. `model`: fixed
    costs plus travel time, repeatable."""

    planning_seconds: float = 0.3
    """Cost of a decision on the clock `model` [s]."""

    mapping_seconds: float = 0.02
    """Cost of mapping a frame on the clock `model` [s]."""

    num_probes: int = 16
    """Number of random views over which mean renderability is averaged."""

    checkpoint_every: int = 1
    """Views between two checkpoints; the last view always has one."""

    max_still_views: int = 100
    """End the run after this number of views in a row without moving: the policy is stuck."""

    until: str | None = None
    """Stop early when the predicted image quality reaches a goal: `psnr:25` for a mean of 25 dB
    over all free-space views, `psnr:20@p10` for at least 20 dB in 90 % of them."""

    until_every: int = 5
    """Views between two forecasts, each of which takes almost a second."""

    capture_every: float | None = None
    """Capture frames while moving from view to view, at most this far apart [m]; by default
    none."""

    capture_rate: float | None = None
    """As --capture-every, by frame rate [Hz]: frames are at most speed / rate apart. No frames are
    captured while turning in place."""

    gaze: str = "panorama"
    """Where the camera points while moving: `ahead`: along the path; `panorama`: at each place in
    the direction of highest utility."""

    exposure: float = 0.0
    """Exposure time of frames captured while moving [s]; 0: no motion blur."""

    blur: float = 1.0
    """Maximum motion blur from rotation [px]."""

    plan_while_moving: bool = False
    """Choose the next view while moving, on the predicted map, and only re-evaluate it on arrival.
    The clock is charged only for planning that outlasts the move."""

    @property
    def captures(self) -> bool:
        """True if frames are captured while moving."""
        return self.capture_every is not None or self.capture_rate is not None

    def piece_at(self, speed: float) -> float:
        """Returns the longest piece of a path between two frames at a speed [m/s], [m].

        It is inf if nothing is captured while moving.
        """
        if self.capture_rate is not None:
            return max(speed / self.capture_rate, LEAST_PIECE)
        return math.inf if self.capture_every is None else self.capture_every

    def check_scales(self) -> None:
        """Refuses lengths that do not fit together; recorded runs that have them still open.

        Raises:
            ValueError: a range beyond what depth images can hold, or voxels too large for it.
        """
        if self.max_range > LARGEST_DEPTH:
            raise InputError(
                f"max_range must be at most {LARGEST_DEPTH:.1f} m, which a depth image can hold, "
                f"got {self.max_range:g}"
            )
        check_voxel_size(self.voxel_size, self.max_range)

    def __post_init__(self) -> None:
        """Refuses invalid settings."""
        super().__post_init__()
        # Written so that NaN fails, too: it would make every flight time and the clock NaN.
        if not LEAST_RATE <= self.speed < math.inf:
            raise InputError(
                f"speed must be positive and finite, at least {LEAST_RATE:g}, got {self.speed}"
            )
        # Two of them divide the number of views: a zero would fail a run after its first view.
        for name in ("num_probes", "checkpoint_every", "max_still_views", "until_every"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.clock not in ("wall", "model"):
            raise InputError(f"clock must be `wall` or `model`, got {self.clock!r}")
        for name in ("planning_seconds", "mapping_seconds"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise InputError(
                    f"{name} must be a finite time >= 0 [s], got {getattr(self, name)}"
                )
        self._check_captures()

    def _check_captures(self) -> None:
        """Refuses invalid settings of frames captured while moving."""
        every, rate = self.capture_every, self.capture_rate
        if every is not None and rate is not None:
            raise InputError("give capture_every or capture_rate, not both")
        if every is not None and not LEAST_PIECE <= every < math.inf:
            raise InputError(f"capture_every must be at least {LEAST_PIECE:g} m, got {every}")
        if rate is not None and not 0.0 < rate < math.inf:
            raise InputError(f"capture_rate must be positive and finite [Hz], got {rate}")
        if self.gaze in RETIRED_GAZES:
            raise InputError(f"gaze {self.gaze!r} has left the package: {RETIRED_GAZES[self.gaze]}")
        if self.gaze not in get_args(GazeName):
            raise InputError(f"gaze must be one of {get_args(GazeName)}, got {self.gaze!r}")
        if not 0.0 <= self.exposure < math.inf:
            raise InputError(f"exposure must be a finite time >= 0 [s], got {self.exposure}")
        if not 0.0 < self.blur < math.inf:
            raise InputError(f"blur must be positive and finite [px], got {self.blur}")
