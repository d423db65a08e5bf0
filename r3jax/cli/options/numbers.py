"""How numbers on the command line are read: `1e5` is a whole number, and mistakes are told."""

from collections.abc import Callable
from decimal import Decimal, InvalidOperation
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin

from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

_DIGITS = 30
"""More than any setting needs; 1e999999999 is not written out."""


def number_rules() -> ConstructorRegistry:
    """What reads `int`, `float`, and either of them where None is the default."""
    registry = ConstructorRegistry()
    registry.primitive_rule(_rule)
    return registry


def whole_number(text: str) -> int:
    """The whole number that a text stands for, as digits or as in 1e5.

    Raises:
        ValueError: it is none; says so in words.
    """
    try:
        value = Decimal(text)
    except InvalidOperation:
        value = Decimal("nan")
    if value.is_finite() and value.adjusted() < _DIGITS and int(value) == value:
        return int(value)
    raise ValueError(f"it takes one whole number, such as 512 or 1e5, got {text!r}")


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"it takes one number, such as 0.05, got {text!r}") from None


_READERS: dict[Any, Callable[[str], int | float]] = {int: whole_number, float: _number}


def _rule(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    is_union = get_origin(info.type) in (Union, UnionType)
    kinds = set(get_args(info.type)) if is_union else {info.type}
    is_optional = NoneType in kinds
    kinds -= {NoneType}
    if len(kinds) != 1 or not kinds <= set(_READERS):
        return None
    kind: type = kinds.pop()
    read = _READERS[kind]

    def from_words(words: list[str]) -> int | float | None:
        return None if is_optional and words == ["None"] else read(words[0])

    name = kind.__name__.upper()
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=f"{{None}}|{name}" if is_optional else name,
        instance_from_str=from_words,
        is_instance=lambda value: isinstance(value, int | kind) or (is_optional and value is None),
        str_from_instance=lambda value: [str(value)],
    )
