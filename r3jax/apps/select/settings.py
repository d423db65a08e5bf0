"""Settings of a selection, which are options of `r3jax select`, too. Its import is light."""

from dataclasses import dataclass

from r3jax.captures.settings import SurveySettings, at_least
from r3jax.errors import InputError

DEFAULT_GAIN = 0.95
"""Share of what all frames give at which the choice ends, by default."""

FRAMES, STAND = "frames", "stand"
"""Targets: the capture's own frames, and views from where people could stand."""


@dataclass(frozen=True)
class SelectSettings(SurveySettings):
    """Which frames are kept.

    Raises:
        ValueError: a setting that makes no sense, or settings that contradict each other; names
            the options.
    """

    frames: int | None = None
    """Frames to keep."""

    share: float | None = None
    """Frames to keep, as a share of all (0.2: a fifth)."""

    gain: float | None = None
    """Keep as many as it takes to reach this share of the renderability that all frames give; by
    default 0.95."""

    targets: str = FRAMES
    """Views that the result is to render well: frames (the capture's own), stand (from where people
    could stand), or a camera path: nerfstudio's camera_path.json, or any capture."""

    keep: tuple[str, ...] = ()
    """Names of frames that stay, whatever they add."""

    drop_blurred: bool = False
    """Leave out blurred frames. Alone it cleans the capture and chooses nothing."""

    drop_duplicates: bool = False
    """Leave out frames that repeat another one. Alone it cleans the capture and chooses nothing."""

    exact: bool = False
    """Evaluate every frame before each choice, which is slower and hardly better."""

    max_frames: int = 5000
    """Frames to look at, at most, evenly spread."""

    def __post_init__(self) -> None:
        """Refuses what makes no sense."""
        super().__post_init__()
        given = [name for name in ("frames", "share", "gain") if getattr(self, name) is not None]
        if len(given) > 1:
            raise InputError(f"--{given[0]} and --{given[1]} both say how many to keep: give one")
        if self.frames is not None:
            at_least(self, {"frames": 1})
        for name in ("share", "gain"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value <= 1.0:
                raise InputError(f"--{name} must lie above 0 and at most at 1, got {value:g}")

    @property
    def chooses(self) -> bool:
        """False where the capture is only cleaned."""
        is_sized = (self.frames, self.share, self.gain) != (None, None, None)
        return is_sized or not (self.drop_blurred or self.drop_duplicates)

    @property
    def wanted_gain(self) -> float | None:
        """Share of what all frames give at which the choice ends; None: it ends by number."""
        if self.gain is None and self.frames is None and self.share is None:
            return DEFAULT_GAIN
        return self.gain

    def number(self, count: int) -> int:
        """Returns how many of `count` frames to keep at most."""
        if self.frames is not None:
            return min(self.frames, count)
        return count if self.share is None else max(1, round(self.share * count))
