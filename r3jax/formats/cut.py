"""Settings for cutting 360 photos into pinhole views, as `formats.cut_views` does."""

from dataclasses import dataclass

from r3jax.errors import InputError


@dataclass(frozen=True)
class Cut:
    """How a photo of 360 degrees is cut.

    Raises:
        InputError: an angle that makes no sense; names the option.
    """

    overlap: float = 10.0
    """Angle that neighboring views share [deg]."""

    hide_below: float = 25.0
    """Half the opening of the cone below the camera that is masked [deg]."""

    def __post_init__(self) -> None:
        """Refuses invalid settings."""
        if not 0.0 <= self.overlap <= 60.0:
            raise InputError(f"--overlap-360 must lie between 0 and 60 degrees, got {self.overlap}")
        if not 0.0 <= self.hide_below < 90.0:
            raise InputError(
                f"--hide-below must be at least 0 and below 90 degrees, got {self.hide_below}"
            )
