"""Settings of a selection; they are also options of `r3jax select`. Imports nothing heavy."""

from dataclasses import dataclass

from r3jax.captures.settings import SurveySettings, at_least
from r3jax.errors import InputError

DEFAULT_GAIN = 0.99
"""Default share of all frames' renderability at which the selection stops. At 0.97 a model still
lost 1.7 dB, from 0.99 on 0.1 to 0.4 dB (experiments/results/select/README.md)."""

FRAMES, STAND = "frames", "stand"
"""Targets: the capture's own frames, and views from where people could stand."""


@dataclass(frozen=True)
class SelectSettings(SurveySettings):
    """Settings that decide which frames are kept.

    Raises:
        ValueError: an invalid setting, or settings that contradict each other; names the options.
    """

    frames: int | None = None
    """Number of frames to keep."""

    share: float | None = None
    """Share of the frames to keep (0.2: one in five)."""

    gain: float | None = None
    """Keep enough frames to reach this share of the renderability with all frames; 0.99 if neither
    --frames nor --share is given."""

    targets: str = FRAMES
    """Views to optimize for: `frames` (the capture's own), `stand` (wherever a person could stand),
    or a camera path (nerfstudio's camera_path.json, or any capture)."""

    keep: tuple[str, ...] = ()
    """Names of frames that are always kept."""

    drop_blurred: bool = False
    """Drop blurred frames. Without --frames, --share or --gain all other frames are kept."""

    drop_duplicates: bool = False
    """Drop near-duplicates. Without --frames, --share or --gain all other frames are kept."""

    exact: bool = False
    """Evaluate every frame before each choice instead of lazily: slower, and hardly better."""

    max_frames: int = 5000
    """Maximum number of frames to read, evenly spread over the capture."""

    def __post_init__(self) -> None:
        """Refuses invalid or contradictory settings."""
        super().__post_init__()
        given = [name for name in ("frames", "share", "gain") if getattr(self, name) is not None]
        if len(given) > 1:
            raise InputError(
                f"--{given[0]} and --{given[1]} both set the number of frames: give only one"
            )
        if self.frames is not None:
            at_least(self, {"frames": 1})
        for name in ("share", "gain"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value <= 1.0:
                raise InputError(f"--{name} must lie in (0, 1], got {value:g}")

    @property
    def chooses(self) -> bool:
        """False if blurred or duplicate frames are dropped and all others are kept."""
        is_sized = (self.frames, self.share, self.gain) != (None, None, None)
        return is_sized or not (self.drop_blurred or self.drop_duplicates)

    @property
    def wanted_gain(self) -> float | None:
        """Share of all frames' renderability at which to stop; None: stop by number."""
        if self.gain is None and self.frames is None and self.share is None:
            return DEFAULT_GAIN
        return self.gain

    def number(self, count: int) -> int:
        """Returns the maximum number of frames to keep out of `count`."""
        if self.frames is not None:
            return min(self.frames, count)
        return count if self.share is None else max(1, round(self.share * count))
