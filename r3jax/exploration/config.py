"""Settings of the loop and its budget. Plain numbers: they go into run.json as they are."""

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
"""Gazes that recorded runs may name: the reason, and where their code is."""

LEAST_PIECE = 0.05
"""Least distance between frames that are captured while moving [m]: the edge of a voxel."""

DEPTH_STEPS_PER_METRE = 5000
"""Recorded depth is in steps of 0.2 mm (TUM's scale)."""

BEYOND_RANGE = 65535
"""Recorded depth where nothing lies within the sensor's range (or within 13.1 m)."""

# One step less: the largest stored value means "beyond the range", not a depth.
LARGEST_DEPTH = (BEYOND_RANGE - 1) / DEPTH_STEPS_PER_METRE
"""What lies farther is recorded as beyond the range [m]."""

Unit = Literal["views", "frames", "seconds", "metres"]


@dataclass(frozen=True)
class Budget:
    """How long a run may last.

    Views are those that a policy chose, and the one at the start; frames count those captured
    while moving, too. Without captures they are the same. Seconds are those of the mission clock.
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
    """Refuses voxels so large that a map of them tells nothing.

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
    """What the loop itself decides, mapping included; the policy has its own settings."""

    remove_moved: bool = False
    """Remove voxels that frames see through. Off, as in every run recorded before there was such
    a setting: nothing moves in the worlds of a simulator."""

    speed: float = 1.0
    """Flight speed [m/s] where the policy's motion has none; turning takes no time then."""

    clock: ClockName = "wall"
    """`wall`: measured planning and mapping, plus flight. `model`: fixed costs, repeatable."""

    planning_seconds: float = 0.3
    """What the clock `model` charges for a decision [s]."""

    mapping_seconds: float = 0.02
    """What the clock `model` charges for a frame that the policy takes in [s]."""

    num_probes: int = 16
    """Views that mean renderability is averaged over."""

    checkpoint_every: int = 1
    """Views between two stored states of the loop; the last one is always stored."""

    max_still_views: int = 100
    """Views in a row without moving that end the run: the policy is stuck."""

    until: str | None = None
    """Stop before the budget is spent, when the forecast of the image quality says that the views
    are enough: `psnr:25` for the mean of all free-space views, `psnr:20@p10` for all but the worst
    tenth."""

    until_every: int = 5
    """Views between two forecasts; each takes most of a second."""

    capture_every: float | None = None
    """Capture frames while moving from view to view, at most this far apart [m]; by default
    none."""

    capture_rate: float | None = None
    """As --capture-every, by frame rate [Hz]: at speed v frames are at most v / rate apart. No
    frames while turning in place."""

    gaze: str = "panorama"
    """Where the camera points while moving: `ahead`: along the path; `panorama`: at each place in
    the direction of highest utility."""

    exposure: float = 0.0
    """Exposure time of a frame captured while moving [s]; 0: turning blurs nothing."""

    blur: float = 1.0
    """Maximum motion blur from rotation [px]."""

    plan_while_moving: bool = False
    """Decide on the next view during the flight, on the map as it will be, and only reconsider on
    arrival: the clock is charged for what the flight does not hide."""

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
        """Refuses lengths that do not fit together; what was recorded with them is still read.

        Raises:
            ValueError: a range beyond what depth images can hold, or voxels so large that a map of
                them tells nothing.
        """
        if self.max_range > LARGEST_DEPTH:
            raise InputError(
                f"max_range must be at most {LARGEST_DEPTH:.1f} m, which a depth image can hold, "
                f"got {self.max_range:g}"
            )
        check_voxel_size(self.voxel_size, self.max_range)

    def __post_init__(self) -> None:
        """Refuses what cannot work."""
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
        """Refuses captures that cannot work."""
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
