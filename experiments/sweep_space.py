"""What a sweep tries: a grid of listed values, or points at random from lists and ranges.

lambda1=4,8,16             values
lambda1=1..64              a range, for a random search; whole numbers stay whole
lambda1=1..64:log          the same, as many points from 1 to 2 as from 32 to 64
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from experiments.settings import Setting, Value, find_setting

Point = dict[str, Value]
"""A value for each swept setting, by its whole name."""


@dataclass(frozen=True)
class Listed:
    """Values one by one."""

    setting: Setting
    values: tuple[Value, ...]

    def draw(self, rng: np.random.Generator) -> Value:
        """Returns one of them."""
        return self.values[int(rng.integers(len(self.values)))]


@dataclass(frozen=True)
class Range:
    """All values from low to high, both included."""

    setting: Setting
    low: float
    high: float
    is_log: bool

    def draw(self, rng: np.random.Generator) -> Value:
        """Returns the uniform, or uniform in the logarithm."""
        is_whole = self.setting.kind is int
        # Each whole number has an interval of its own, the first and the last ones too.
        margin = 0.5 if is_whole else 0.0
        low, high = self.low - margin, self.high + margin
        if self.is_log:
            value = math.exp(rng.uniform(math.log(low), math.log(high)))
        else:
            value = float(rng.uniform(low, high))
        value = min(max(value, self.low), self.high)
        return round(value) if is_whole else value


Axis = Listed | Range


def parse_axes(words: Sequence[str], known: Mapping[str, Setting]) -> tuple[Axis, ...]:
    """Returns what is swept, from `NAME=VALUES` words.

    Raises:
        ValueError: a word, a name or a value that is not understood, a setting given twice.
    """
    axes = tuple(_parse_axis(word, known) for word in words)
    names = [axis.setting.name for axis in axes]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise ValueError(f"{', '.join(sorted(twice))} is given twice: join its values with commas")
    return axes


def _parse_axis(word: str, known: Mapping[str, Setting]) -> Axis:
    name, separator, text = word.partition("=")
    if not (name and separator and text):
        raise ValueError(f"--vary takes NAME=VALUES such as lambda1=4,8,16, got {word!r}")
    setting = find_setting(name.strip(), known)
    if ".." in text:
        return _parse_range(setting, text)
    values = tuple(setting.parse(value.strip()) for value in text.split(","))
    if len(set(values)) < len(values):
        raise ValueError(f"{setting.name} has a value twice: {text}")
    return Listed(setting, values)


def _parse_range(setting: Setting, text: str) -> Range:
    limits, colon, scale = text.partition(":")
    if setting.kind not in (int, float) or (colon and scale != "log"):
        raise ValueError(
            f"{setting.name}={text}: a range is LOW..HIGH or LOW..HIGH:log, and only of numbers"
        )
    low, _, high = limits.partition("..")
    low, high = (float(setting.parse(limit.strip()) or 0.0) for limit in (low, high))
    if not low < high or (scale == "log" and low <= 0.0):
        positive = " and LOW > 0" if scale == "log" else ""
        raise ValueError(f"{setting.name}={text}: a range needs LOW < HIGH{positive}")
    return Range(setting, low, high, scale == "log")


def grid_points(axes: Sequence[Axis]) -> tuple[Point, ...]:
    """Returns every combination of the listed values; the last setting varies fastest.

    Raises:
        ValueError: a range, which has no end of values.
    """
    for axis in axes:
        if isinstance(axis, Range):
            raise ValueError(
                f"{axis.setting.name} has a range: list values with commas, or draw points from "
                "it with --random N"
            )
    names = [axis.setting.name for axis in axes]
    values = [axis.values for axis in axes if isinstance(axis, Listed)]
    return tuple(dict(zip(names, chosen, strict=True)) for chosen in itertools.product(*values))


def random_points(axes: Sequence[Axis], count: int, seed: int) -> tuple[Point, ...]:
    """Returns the different points at random; the first ones are the same whatever the count.

    Raises:
        ValueError: fewer than one, or more than there are.
    """
    most = math.prod(_size(axis) for axis in axes)
    if not 1 <= count <= most:
        raise ValueError(f"--random takes 1 to {most} points of this space, got {count}")
    rng = np.random.default_rng(seed)
    found: dict[tuple[Value, ...], Point] = {}
    while len(found) < count:
        point = {axis.setting.name: axis.draw(rng) for axis in axes}
        found.setdefault(tuple(point.values()), point)
    return tuple(found.values())


def _size(axis: Axis) -> float:
    """Returns how many values there are."""
    if isinstance(axis, Listed):
        return len(axis.values)
    return int(axis.high - axis.low) + 1 if axis.setting.kind is int else math.inf


def with_default(points: Sequence[Point], axes: Sequence[Axis]) -> tuple[Point, ...]:
    """Returns the points, and the default among them: what every other one is compared with."""
    default = {axis.setting.name: axis.setting.default for axis in axes}
    return tuple(points) if default in points else (default, *points)
