"""Settings of the scores. Numbers are traced, so that a sweep over them compiles once."""

import importlib
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r3jax.errors import InputError
from r3jax.geometry.arguments import a_camera, a_pose, checked, one, or_none
from r3jax.geometry.cameras import is_traced
from r3jax.kernels.calls import Forms
from r3jax.mapping.state import a_map
from r3jax.visibility.views import VisibilityConfig, as_float32


class Score(eqx.Module):
    """How R of a voxel is computed, and how much the voxel counts."""

    forms: Forms = eqx.field(default=Forms(), static=True)
    """Forms of kappa and delta."""

    powers: tuple[Float[Array, ""] | None, ...] = (None, None, None)
    """Of bias, noise and resolution; None: 1."""

    combine: Callable[..., Array] | None = None
    """`ScoringConfig.combine`."""

    importance: Callable[..., Array] | None = None
    """`ScoringConfig.importance`."""

    @property
    def has_kernel(self) -> bool:
        """Returns whether machine code computes it."""
        own = (*self.powers, self.combine, self.importance)
        return all(part is None for part in own)


PAPER = Score()
"""The paper's equations and algorithms."""


def _as_function(function: Any) -> Any:
    """Imports a function by name, and wraps it, so that settings that hold it may be traced."""
    if isinstance(function, str):
        module, _, name = function.partition(":")
        try:
            function = getattr(importlib.import_module(module), name)
        except (ImportError, AttributeError, ValueError) as error:
            raise InputError(
                f"{function!r} cannot be imported as package.module:function: {error}"
            ) from error
    if function is not None and not callable(function):
        raise InputError(
            f"combine and importance must be functions of voxels, got {type(function).__name__}"
        )
    is_tree = function is None or isinstance(function, (eqx.Module, jax.tree_util.Partial))
    return function if is_tree else jax.tree_util.Partial(function)


def function_name(function: Any) -> str:
    """Returns the name by which a record finds a function again, package.module:function.

    Raises:
        ValueError: it has none.
    """
    plain = getattr(function, "func", function)
    name = f"{getattr(plain, '__module__', None)}:{getattr(plain, '__qualname__', None)}"
    try:
        is_found = getattr(_as_function(name), "func", None) is plain
    except InputError:
        is_found = False
    if not is_found:
        raise InputError(
            f"{name} cannot be recorded, as no later run could find it again: define combine and "
            "importance as functions of a module that can be imported"
        )
    return name


def _as_power(power: Any) -> Float[Array, ""] | None:
    return None if power is None else as_float32(power)


class ScoringConfig(VisibilityConfig):
    """Settings of the closed forms and the utilities, beside those of visibility."""

    lambda1: Float[Array, ""] = eqx.field(default=16.0, converter=as_float32)
    """Weight of a visible unexplored cell relative to a voxel with R = 0. A cell of 0.2 m hides a
    surface of about 4 x 4 voxels of 5 cm; with a weight of 1, runs through a large house do not
    leave the first rooms."""

    kappa: str = eqx.field(default="box", static=True)
    """`box`: 1 inside the bounding box of the seen directions, else 2. `one`: always 1."""

    delta: str = eqx.field(default="trace", static=True)
    """`trace`: the paper's Algorithm 2. `pairwise`: its text, 1 - 2 tr(M) / (n - 1)."""

    panorama_bins: int = eqx.field(default=526, static=True)
    """Number of directions of the panorama; 526 are 10 degrees apart."""

    bias_power: Float[Array, ""] | None = eqx.field(default=None, converter=_as_power)
    """Power of the bias in R; None: 1. As all of the following it makes scores plain JAX, slower
    than machine code."""

    noise_power: Float[Array, ""] | None = eqx.field(default=None, converter=_as_power)
    """Power of the noise in R; None: 1."""

    resolution_power: Float[Array, ""] | None = eqx.field(default=None, converter=_as_power)
    """Power of the resolution in R; None: 1."""

    combine: Callable[..., Array] | None = eqx.field(default=None, converter=_as_function)
    """Your own R: `combine(voxels, terms)` returns R of every voxel, [n], from a `MapState` of
    voxels and their `Renderability`. It must jit; R is clipped to [0, 1], and 0 where nothing was
    seen. A function, or its name `package.module:function`. None: the product of the terms."""

    importance: Callable[..., Array] | None = eqx.field(default=None, converter=_as_function)
    """How much each voxel counts: `importance(voxels)` returns weights >= 0, [n], of a `MapState`
    of voxels, for sums of 1 - R and means over pixels. A function, its name, or a `CellImportance`.
    None: 1."""

    @property
    def score(self) -> Score:
        """How R of a voxel is computed."""
        powers = (self.bias_power, self.noise_power, self.resolution_power)
        return Score(Forms(self.kappa, self.delta), powers, self.combine, self.importance)

    def __check_init__(self) -> None:
        """Refuses invalid settings."""
        if self.kappa not in ("box", "one"):
            raise InputError(f"kappa must be 'box' or 'one', got {self.kappa!r}")
        if self.delta not in ("trace", "pairwise"):
            raise InputError(f"delta must be 'trace' or 'pairwise', got {self.delta!r}")
        # A traced weight has no value to check.
        if not is_traced(self.lambda1) and not np.isfinite(self.lambda1).all():
            raise InputError(f"lambda1 (--lambda1) must be finite in float32, got {self.lambda1}")
        for name in ("bias_power", "noise_power", "resolution_power"):
            power = getattr(self, name)
            if power is not None and not is_traced(power) and not 0.0 <= float(power) < np.inf:
                raise InputError(f"{name} must be a finite number >= 0, got {power}")


class CellImportance(eqx.Module):
    """Importance of voxels from an array over space, for `ScoringConfig.importance`."""

    values: Float[Array, "X Y Z"] = eqx.field(converter=as_float32)
    """Weights >= 0 of boxes of space."""

    origin: Float[Array, " 3"] = eqx.field(converter=as_float32)
    """Lowest corner of the array [m]."""

    cell_size: Float[Array, ""] = eqx.field(converter=as_float32)
    """Edge of a box [m]."""

    outside: Float[Array, ""] = eqx.field(default=1.0, converter=as_float32)
    """Weight of voxels outside of the array."""

    def __call__(self, voxels: Any) -> Float[Array, " n"]:
        """Looks up the box of each voxel's center."""
        last = jnp.asarray(self.values.shape, jnp.float32)[:, None] - 1.0
        box = jnp.floor((voxels.center - self.origin[:, None]) / self.cell_size)
        is_inside = jnp.all((box >= 0.0) & (box <= last), axis=0)
        index = jnp.clip(box, 0.0, last).astype(jnp.int32)
        return jnp.where(is_inside, self.values[tuple(index)], self.outside)


RETIRED = {"sample": "it was off, and no table rests on it; commit 4fa1d20 has it"}
"""Removed settings: why they were removed, and the commit with their code."""


def scoring_config_of(settings: dict[str, Any]) -> ScoringConfig:
    """Makes the settings from those of a record or a command.

    Raises:
        ValueError: no setting has one of these names (any more), or a value is impossible.
    """
    for name in settings:
        if name in RETIRED:
            raise InputError(f"setting scoring.{name} has left the package: {RETIRED[name]}")
    return ScoringConfig(**settings)


scoring_settings = or_none(one(ScoringConfig, "None: its defaults"))

checked_view = checked(state=a_map, camera=a_camera, T_world_camera=a_pose, config=scoring_settings)
"""Decorates a score of one view of a map with checks of its arguments."""
