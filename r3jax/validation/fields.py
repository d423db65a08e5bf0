"""Records from JSON as dataclasses, every field of the type that its annotation names.

Written by hand: msgspec's conversion to dataclasses ignores fields that they do not have, takes
numbers that are not finite, names one missing field where several are, and does not quote what it
found. With checks for these around it, it would save some twenty lines.
"""

import dataclasses
import math
import types
import typing
from collections.abc import Mapping
from typing import Any, TypeVar

from r3jax.validation.errors import ForeignFileError

T = TypeVar("T")


def build(kind: type[T], plain: Any, /, **ready: Any) -> T:
    """Makes a dataclass of a JSON object.

    Args:
        kind: the dataclass. Its fields may be numbers, texts, lists, dictionaries and unions of
            these; a float may be written as a whole number.
        plain: the object.
        **ready: fields that were made already; they replace those of the object.

    Raises:
        ForeignFileError: no object; a field that is missing, unknown or of another type; a number
            that is not finite.
    """
    fields = {field.name: field for field in dataclasses.fields(typing.cast(Any, kind))}
    if not isinstance(plain, Mapping):
        raise ForeignFileError(f"expected the fields of a {kind.__name__}, got {_short(plain)}")
    missing = [
        name
        for name, field in fields.items()
        if name not in plain
        and name not in ready
        and field.default is dataclasses.MISSING
        and field.default_factory is dataclasses.MISSING
    ]
    unknown = sorted(set(plain) - set(fields))
    if missing or unknown:
        what = f"lacks {', '.join(missing)}" if missing else f"has an unknown {_short(unknown[0])}"
        raise ForeignFileError(f"the {kind.__name__} {what}")
    hints = typing.get_type_hints(kind)
    for name, value in plain.items():
        if name not in ready:
            check_type(name, value, hints[name])
    return kind(**{**plain, **ready})


def check_fields(name: str, record: Any, kinds: Mapping[str, Any]) -> None:
    """Refuses a JSON object that lacks fields, or has them of other types; others may be there.

    Raises:
        ForeignFileError: says which field of `name`.
    """
    check_type(name, record, dict[str, Any])
    missing = sorted(kinds.keys() - record.keys())
    if missing:
        raise ForeignFileError(f"`{name[:80]}` lacks {', '.join(missing)}")
    for field, kind in kinds.items():
        check_type(f"{name}.{field}", record[field], kind)


def check_type(name: str, value: Any, hint: Any) -> None:
    """Refuses a value from JSON that is not of a type.

    Raises:
        ForeignFileError: it is not; says which name, what was expected and what is there.
    """
    if not _is(value, hint):
        expected = getattr(hint, "__name__", str(hint)) if not typing.get_args(hint) else str(hint)
        raise ForeignFileError(f"`{name[:80]}` must be {expected}, got {_short(value)}")


def _is(value: Any, hint: Any) -> bool:
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any:
        return True
    if origin is typing.Literal:
        return value in args
    if origin in (typing.Union, types.UnionType):
        return any(_is(value, arg) for arg in args)
    if origin in (list, tuple):
        inner = args[0] if args else Any
        return isinstance(value, list) and all(_is(x, inner) for x in value)
    if origin is dict:
        return isinstance(value, dict) and all(_is(x, args[1]) for x in value.values())
    if hint is float:
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        return is_number and math.isfinite(value)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(value, types.NoneType if hint is None else hint)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
