"""Every setting that a cell of the benchmark may have: by name, with its default and a sentence.

    policy.NAME      of `PlannerConfig` and `ScoringConfig`: how views are chosen
    map.NAME         of `ExplorationConfig`: the map and the coarse grid
    loop.NAME        of `ExplorationConfig`: the mission
    sensor.NAME      of the depth sensor
    training.NAME    of `TrainConfig`

What the test views depend on (resolution, field of view, resolution of the training) is no
setting here: scores on different pictures cannot be compared.
"""

import ast
import difflib
import functools
import inspect
import math
import textwrap
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, replace
from typing import Any, Literal

from r3jax.apps.benchmark.cells import OWN_OF_LOOP, OWN_OF_TRAINER, Cell, Conditions
from r3jax.exploration.config import ExplorationConfig
from r3jax.planning.policies.r3_ahead import AheadConfig
from r3jax.scoring.config import ScoringConfig
from r3jax.splatting.training.config import TrainConfig

Value = bool | int | float | str | None

Part = Literal["conditions", "loop", "trainer", "policy"]
"""Where a cell carries a setting."""

_OF_CONDITIONS = {
    "map.voxel_size": "voxel_size",
    "map.cell_size": "cell_size",
    "map.capacity": "map_capacity",
    "sensor.max_range": "max_range",
    "sensor.noise": "noise",
    "training.iterations": "iterations",
    "training.gaussians": "gaussians",
    "training.capacity": "capacity",
}
"""Settings for which `Conditions` has fields, by name."""

_OF_MISSION = (
    "speed", "num_probes", "max_still_views", "until", "until_every",
    "capture_every", "capture_rate", "gaze", "exposure", "blur", "plan_while_moving",
)  # fmt: skip
"""Fields of `ExplorationConfig` that concern neither the map nor the grid."""

_OPTIONAL: dict[str, type] = {"until": str, "capture_every": float, "capture_rate": float}
"""Optional fields that are no whole numbers."""


@dataclass(frozen=True)
class Setting:
    """One number, switch or word."""

    name: str
    """As users write it, such as `policy.lambda1`."""

    default: Value
    """Its value where nothing is given."""

    kind: type
    """bool, int, float or str."""

    sentence: str
    """What it is."""

    part: Part
    """Where a cell carries it, ..."""

    field: str
    """... and by which name."""

    @property
    def short(self) -> str:
        """The last part of its name."""
        return self.name.rpartition(".")[2]

    def parse(self, text: str) -> Value:
        """Returns a value of this setting from text.

        Raises:
            ValueError: the text is no value of its kind.
        """
        if self.default is None and text == "none":
            return None
        try:
            if self.kind is bool:
                return {"true": True, "false": False}[text.lower()]
            if self.kind is int:
                number = float(text)
                if not number.is_integer():
                    raise ValueError
                return int(number)
            value = self.kind(text)
            if self.kind is float and not math.isfinite(value):
                raise ValueError
            return value
        except (KeyError, ValueError, OverflowError):
            raise ValueError(f"{self.name} takes {_KINDS[self.kind]}, got {text!r}") from None


_KINDS = {bool: "true or false", int: "whole numbers", float: "numbers", str: "words"}


def known_settings(conditions: Conditions) -> dict[str, Setting]:
    """Returns all settings by name; defaults are those of the conditions where these have a say."""
    found = [
        _setting(name, Conditions, "conditions", field, getattr(conditions, field))
        for name, field in _OF_CONDITIONS.items()
    ]
    for name, default in _defaults(AheadConfig).items():
        found.append(_setting(f"policy.{name}", AheadConfig, "policy", name, default))
    for name, default in (_defaults(ScoringConfig) | {"max_range": conditions.max_range}).items():
        # This is how `Conditions.policy` tells them from those of the planner.
        field = f"scoring.{name}"
        found.append(_setting(f"policy.{name}", ScoringConfig, "policy", field, default))
    for name, default in _defaults(ExplorationConfig, OWN_OF_LOOP).items():
        group = "loop" if name in _OF_MISSION else "map"
        found.append(_setting(f"{group}.{name}", ExplorationConfig, "loop", name, default))
    for name, default in _defaults(TrainConfig, OWN_OF_TRAINER).items():
        found.append(_setting(f"training.{name}", TrainConfig, "trainer", name, default))
    return {setting.name: setting for setting in sorted(found, key=lambda setting: setting.name)}


def _defaults(config: type, leave_out: tuple[str, ...] = ()) -> dict[str, Any]:
    return {
        field.name: field.default
        for field in fields(config)
        if field.default is not MISSING and field.name not in leave_out
    }


def _setting(name: str, config: type, part: Part, field: str, default: Value) -> Setting:
    # Of what is optional there is no default that the kind could be taken from.
    kind = type(default) if default is not None else _OPTIONAL.get(field, int)
    sentence = sentences_of(config).get(field.removeprefix("scoring."), "")
    return Setting(name, default, kind, sentence, part, field)


@functools.cache
def sentences_of(config: type) -> dict[str, str]:
    """The first sentence below each field of a class, inherited ones too, by the field's name."""
    bases = [base for base in reversed(config.__mro__) if base.__module__.startswith("r3jax")]
    return {name: text for base in bases for name, text in _own_sentences(base).items()}


def _own_sentences(config: type) -> dict[str, str]:
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(config))).body
    assert isinstance(tree, ast.ClassDef)
    found = {}
    for field, below in zip(tree.body, tree.body[1:], strict=False):
        if not (isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)):
            continue
        if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
            text = " ".join(str(below.value.value).split())
            # Where words may be chosen, each has a sentence of its own.
            is_choice = text.startswith("`")
            found[field.target.id] = (text if is_choice else text.partition(". ")[0]).rstrip(".")
    return found


def find_setting(word: str, known: Mapping[str, Setting]) -> Setting:
    """Returns a setting by its name, or by the last part of it where that is enough.

    Raises:
        ValueError: no setting, or several, go by that name; says which are near.
    """
    if word in known:
        return known[word]
    same = [setting for setting in known.values() if setting.short == word]
    if len(same) == 1:
        return same[0]
    if same:
        names = " or ".join(setting.name for setting in same)
        raise ValueError(f"{word} may be {names}: give the whole name")
    by_text = {setting.short: setting.name for setting in known.values()}
    close = difflib.get_close_matches(word.rpartition(".")[2], by_text, n=3, cutoff=0.5)
    near = list(dict.fromkeys([by_text[text] for text in close]))
    near += [name for name in difflib.get_close_matches(word, known, n=3) if name not in near]
    hint = f"did you mean {', '.join(near)}? " if near else ""
    raise ValueError(f"there is no setting {word!r}: {hint}--list shows all of them")


def with_settings(cell: Cell, values: Mapping[str, Value]) -> Cell:
    """Returns the same cell under other settings.

    A policy's setting at its default is left out, so that it is the same cell whether it was
    given or not.

    Args:
        cell: what to change.
        values: by the whole name of the setting.

    Raises:
        ValueError: a value that cannot work.
    """
    names: tuple[Part, ...] = ("conditions", "loop", "trainer", "policy")
    parts: dict[Part, dict[str, Any]] = {name: {} for name in names}
    known = known_settings(cell.conditions)
    for name, value in values.items():
        parts[known[name].part][known[name].field] = value
    conditions = replace(
        cell.conditions,
        **parts["conditions"],
        loop=cell.conditions.loop | parts["loop"],
        trainer=cell.conditions.trainer | parts["trainer"],
    )
    # The range of the sensor, which may just have changed, is the default of the scores' range.
    known = known_settings(conditions)
    defaults = {s.field: s.default for s in known.values() if s.part == "policy"}
    settings = {
        name: value
        for name, value in (cell.settings | parts["policy"]).items()
        if name not in defaults or value != defaults[name]
    }
    conditions.policy(cell.policy, settings)  # refuses what it cannot work with
    return replace(cell, conditions=conditions, settings=settings)
