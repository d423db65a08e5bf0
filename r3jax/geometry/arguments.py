"""Validates arguments of the public API: mistakes that would give plausible but wrong results.

Types and shapes are known while tracing, so they are checked under jit, too. Values are checked
outside jit; under jit an invalid pose makes the result NaN (`cameras.nan_unless_valid`).
"""

import functools
import inspect
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import numpy as np

from r3jax.errors import InputError
from r3jax.geometry.cameras import Camera, is_traced, rigid_error

P = ParamSpec("P")
R = TypeVar("R")

Check = Callable[[str, Any], None]
"""A check: takes the name and the value of an argument, and raises an error if it is invalid."""


def checked(**checks: Check) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorates a call with checks of arguments, by their names. Defaults are not checked."""

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        # Computed once, while decorating: calls need no reflection.
        order = list(inspect.signature(function).parameters)
        usage = f"{getattr(function, '__name__', '')}({', '.join(order)})"
        places = [(order.index(name), name, check) for name, check in checks.items()]

        @functools.wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            for place, name, check in places:
                if place < len(args):
                    value = args[place]
                elif name in kwargs:
                    value = kwargs[name]
                else:
                    # Left to its default, or missing, which the call itself reports.
                    continue
                try:
                    check(name, value)
                except TypeError as error:
                    # A wrong type often means a wrong order, for which the usage helps.
                    raise TypeError(f"{error}; the call is {usage}") from None
            return function(*args, **kwargs)

        return call

    return decorate


def one(kind: type, hint: str, leaf: str = "", ndim: int = 0) -> Check:
    """Checks that an argument is a single object of a class, neither an array nor a stack of them.

    Args:
        kind: its class.
        hint: how to make such an object.
        leaf: name of an array in it; empty: none.
        ndim: the axes that this array has in one object.

    Returns:
        The check. It raises a TypeError for another kind, and a ValueError for a stack.
    """

    def check(name: str, value: Any) -> None:
        if not isinstance(value, kind):
            raise TypeError(
                f"{name} must be an r3jax.{kind.__name__} ({hint}), got {describe(value)}"
            )
        # A vmapped constructor makes one object of stacked arrays: only the number of axes shows
        # it.
        if leaf and (found := np.ndim(getattr(value, leaf))) != ndim:
            raise InputError(
                f"{name} must be one {kind.__name__}, but its {leaf} has {found} axes instead of "
                f"{ndim}: use jax.vmap over several"
            )

    return check


def or_none(check: Check) -> Check:
    """Lets None through."""
    return lambda name, value: None if value is None else check(name, value)


a_camera = one(
    Camera,
    "of a matrix of intrinsics: Camera(width, height, fx, fy, cx, cy), of an angle of view: "
    "Camera.from_fov",
    leaf="fx",
)


def a_pose(name: str, value: Any) -> None:
    """Checks that an argument is one rigid transform, [4, 4].

    Raises:
        TypeError: no array.
        ValueError: another shape, several poses, or one that is not rigid or not finite.
    """
    shape = _shape(name, value, "[4, 4]")
    if shape != (4, 4):
        raise InputError(
            f"{name} must be one pose, a 4x4 matrix, got shape {shape}{_stacked(shape, (4, 4))}"
        )
    # Under jit the value is not known: there `nan_unless_valid` makes the score NaN instead.
    if not is_traced(value) and (problem := rigid_error(np.asarray(value))) is not None:
        raise InputError(f"{name}: {problem}")


def a_point(name: str, value: Any) -> None:
    """Checks that an argument is one finite point or direction, [3].

    Raises:
        TypeError: no array.
        ValueError: another shape, several points, or one that is not finite.
    """
    shape = _shape(name, value, "[3]")
    if shape != (3,):
        raise InputError(f"{name} must have shape [3], got {shape}{_stacked(shape, (3,))}")
    if not is_traced(value) and not np.isfinite(point := np.asarray(value)).all():
        raise InputError(f"{name} is not finite: {point.tolist()}")


def points_of_3(name: str, value: Any) -> None:
    """Checks that an argument is an array of points, [..., 3].

    Raises:
        TypeError: no array.
        ValueError: another shape.
    """
    shape = _shape(name, value, "[..., 3]")
    if shape[-1:] != (3,):
        raise InputError(f"{name} must have shape [..., 3], got {shape}")


def describe(value: Any) -> str:
    """Describes an argument, for errors."""
    shape = getattr(value, "shape", None)
    return type(value).__name__ if shape is None else f"an array of shape {tuple(shape)}"


def _shape(name: str, value: Any, wanted: str) -> tuple[int, ...]:
    # Checked by attributes: tracers and arrays of any library pass, lists do not.
    if not hasattr(value, "shape") or not hasattr(value, "dtype"):
        raise TypeError(f"{name} must be an array {wanted}, got {describe(value)}")
    return tuple(value.shape)


def _stacked(shape: tuple[int, ...], wanted: tuple[int, ...]) -> str:
    # For a batch the error can name the remedy.
    if shape[1:] == wanted:
        return f": the call takes one at a time, use jax.vmap over the {shape[0]}"
    return ""
