"""The robot: its body, height, limits of turning, and speed.

Constraints only change the candidates and the costs of paths. `Limits` are those of a motion at a
pose; every policy's candidates pass through them.
"""

import math
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

from r3jax.errors import InputError
from r3jax.planning.robot.body import Body
from r3jax.validation.errors import did_you_mean

UNLIMITED = (-math.inf, math.inf)
"""Heights of a robot without a limit [m]."""

LEAST_RATE = 1e-3
"""Minimum speed [m/s], turn rate [deg/s] and turn per meter [deg/m]; smaller values would make
flight times overflow."""

_LEVEL = 90.0
"""Elevation of a camera that looks straight up [deg]."""


def _check_range(name: str, values: tuple[float, float], unit: str) -> None:
    if len(values) != 2 or not all(math.isfinite(value) for value in values):
        raise InputError(f"{name} must be two finite numbers {unit}, got {values}")
    if values[0] > values[1]:
        raise InputError(f"{name} {_range(values)} are upside down: give the lower one first")


def _range(values: tuple[float, float]) -> str:
    return f"{values[0]:g} to {values[1]:g}"


@dataclass(frozen=True)
class Motion:
    """The motion of a robot or a person with a camera. The default is a free-flying camera.

    Raises:
        ValueError: an invalid setting.
    """

    heights: tuple[float, float] | None = None
    """Lowest and highest camera position [m]; None: any."""

    heights_above: Literal["start", "world"] = "start"
    """Origin of `heights`: the camera's start, or the world's z = 0."""

    elevations: tuple[float, float] = (-_LEVEL, _LEVEL)
    """Lowest and highest elevation of the viewing direction [deg]. A camera that only turns around
    the vertical has a single elevation, the tilt of its mounting."""

    body: float | Body = 0.0
    """The body that must fit at the camera's positions. A number is the form of earlier versions: a
    ball with radius `safety_margin`, which must be known to be free, and below it a cylinder of
    this length [m], in which nothing may be known to be occupied."""

    speed: float | None = None
    """Speed along the path [m/s]; None: that of the loop's settings, and turning takes no time."""

    turn_rate: float | None = None
    """Speed of turning at the end of the path [deg/s]; None: turning takes no time."""

    turn_per_meter: float | None = None
    """Maximum turn per meter of straight distance between two views [deg/m], as turning in place
    blurs images. None: no limit."""

    fixed_camera: bool = False
    """True if the camera is fixed to the robot: frames captured while moving look along the
    path."""

    def __post_init__(self) -> None:
        """Refuses invalid settings, and says what to do."""
        if self.heights is not None:
            _check_range("heights", self.heights, "[m]")
            if self.heights_above not in ("start", "world"):
                raise InputError(
                    f"heights_above must be `start` or `world`, got {self.heights_above!r}"
                )
            if self.heights_above == "start" and not self.heights[0] <= 0.0 <= self.heights[1]:
                raise InputError(
                    f"heights {_range(self.heights)} m above the start leave out the start itself: "
                    "let them hold 0, or count them from the world's z = 0 (heights_above)"
                )
        _check_range("elevations", self.elevations, "[degrees]")
        if not -_LEVEL <= self.elevations[0] <= self.elevations[1] <= _LEVEL:
            raise InputError(
                f"elevations must lie between -90 (straight down) and 90 degrees (straight up), "
                f"got {_range(self.elevations)}"
            )
        if not isinstance(self.body, Body) and not (math.isfinite(self.body) and self.body >= 0.0):
            raise InputError(f"body must be a finite length >= 0 [m], got {self.body}")
        for name in ("speed", "turn_rate", "turn_per_meter"):
            value = getattr(self, name)
            if value is not None and not LEAST_RATE <= value < math.inf:
                raise InputError(
                    f"{name} must be positive and finite, at least {LEAST_RATE:g}, got {value}; "
                    "leave it out for no limit"
                )
        if self.turn_rate is not None and self.speed is None:
            raise InputError("turn_rate needs speed [m/s]: both together give the time of a path")

    @property
    def looks_anywhere(self) -> bool:
        """True if any viewing direction is allowed, independent of the previous one."""
        return self.elevations == (-_LEVEL, _LEVEL) and self.turn_per_meter is None

    @property
    def is_relative(self) -> bool:
        """True if the allowed heights depend on where the camera started."""
        return self.heights is not None and self.heights_above == "start"

    def heights_from(self, start: float) -> tuple[float, float]:
        """Computes the allowed heights of the camera [m], world, after a start at `start`."""
        if self.heights is None:
            return UNLIMITED
        base = start if self.is_relative else 0.0
        return base + self.heights[0], base + self.heights[1]

    def seconds(self, length: float, angle: float) -> float | None:
        """Computes the time for a path of `length` [m] and a turn by `angle` [rad] [s].

        It is None if the motion has no speed.
        """
        if self.speed is None:
            return None
        return length / self.speed + self.turning(angle)

    def turning(self, angle: float) -> float:
        """Computes the time for a turn by `angle` [rad] alone [s]."""
        return 0.0 if self.turn_rate is None else math.degrees(angle) / self.turn_rate


MOTIONS = {
    "free": Motion(),
    "ground": Motion(
        heights=(0.0, 0.0), elevations=(0.0, 0.0), body=Body(), speed=0.5, turn_rate=60.0,
        fixed_camera=True,
    ),
    "gimbal": Motion(elevations=(-90.0, 30.0), speed=1.0, turn_rate=90.0),
    "handheld": Motion(
        heights=(-0.6, 0.4), elevations=(-60.0, 60.0), speed=0.5, turn_rate=45.0,
        turn_per_meter=90.0, fixed_camera=True,
    ),
}  # fmt: skip
"""Presets by name: a free-flying camera; a wheeled robot with a level camera at its initial height;
a drone whose gimbal cannot look far up; a person."""


def make_motion(name: str = "free", **changes: Any) -> Motion:
    """Makes a motion by name, with other values for some of its fields.

    Raises:
        ValueError: an unknown name or field, or an invalid value.
    """
    if name not in MOTIONS:
        hint = did_you_mean(name, MOTIONS)
        raise InputError(f"unknown motion {name!r}{hint}; known: {', '.join(MOTIONS)}")
    known = [field.name for field in fields(Motion)]
    unknown = [field for field in changes if field not in known]
    if unknown:
        raise InputError(f"a motion has no setting {', '.join(unknown)}; known: {', '.join(known)}")
    return replace(MOTIONS[name], **changes)


def check_height(height: float, heights: tuple[float, float]) -> None:
    """Refuses a camera at a height [m] outside its robot's range.

    Raises:
        ValueError: says what to do.
    """
    low, high = heights
    # A tolerance of a millimeter: the pose may have been rounded to float32.
    if not low - 1e-3 <= height <= high + 1e-3:
        raise InputError(
            f"the camera is at a height of {height:.3f} m, but its motion's heights are {low:.3f} "
            f"to {high:.3f} m above the world's z = 0: start within them, or change `heights`"
        )


def motion_of_record(record: Any) -> Motion:
    """Reads a motion from a JSON object; None, from old records, means a free camera.

    Raises:
        ValueError: an unknown field, a value of another type, or an invalid one.
    """
    if not isinstance(record, dict | None):
        raise InputError(f"a motion must be an object with its settings, got {record!r}")
    # JSON has no tuples, and a list never equals a tuple.
    plain = _with_tuples(record or {})
    if isinstance(plain.get("body"), dict):
        plain["body"] = Body(**plain["body"])
    return make_motion("free", **plain)


def _with_tuples(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _with_tuples(v) for k, v in value.items()}
    return tuple(_with_tuples(v) for v in value) if isinstance(value, list) else value


def motion_of(policy: object) -> Motion:
    """Returns the motion of a policy's settings; a free-flying camera if they have none."""
    return getattr(getattr(policy, "config", None), "motion", MOTIONS["free"])
