"""JSON without what Python's reader lets through, and records from it.

NaN, doubled keys and endless nesting are refused. msgspec's reader is stricter than Python's, but
accepts repeated keys and integers of any length, without an option against it; Python's
has a hook for each. msgspec's conversion to dataclasses ignores fields that they do not have, takes
numbers that are not finite, names one missing field where several are, and does not quote what it
found; so every field of a record is checked here against the type that its annotation names.
"""

import dataclasses
import hashlib
import json
import math
import types
import typing
from collections.abc import Mapping
from typing import Any, TypeVar

from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import plain_text

_SEAL = "seal"

_MAX_PARTS = 4_000_000
"""Values of one text: a list takes 60 bytes of memory, and three of the file."""

_LARGEST_WHOLE = 1 << 63
"""Whole numbers beyond this fit in no array and no float."""


def parse_json(data: bytes | str) -> Any:
    """Parses a JSON text. All its numbers are finite, all its texts can be encoded.

    Raises:
        ForeignFileError: not UTF-8, not JSON, numbers that are not finite or have more than 63
            bits, a key that occurs twice, nested too deeply, more values than fit into memory.
    """
    try:
        text = data if isinstance(data, str) else plain_text(data).decode("utf-8")
        if sum(text.count(sign) for sign in "[{,") > _MAX_PARTS:
            raise ForeignFileError(
                f"the JSON holds more than {_MAX_PARTS:,} values: it is something else"
            )
        value = json.loads(
            text,
            object_pairs_hook=_without_doubles,
            parse_constant=_refuse,
            parse_float=_finite,
            parse_int=_whole,
        )
        if "\\ud" in text.lower():  # only an escape can make half a character
            json.dumps(value, ensure_ascii=False).encode("utf-8")
    except RecursionError:
        raise ForeignFileError("the JSON is nested too deeply") from None
    except ForeignFileError:
        raise
    except json.JSONDecodeError as error:
        where = f"line {error.lineno}, " if "\n" in error.doc else ""
        told = f"this is not JSON ({error.msg}, {where}column {error.colno})"
        raise ForeignFileError(told) from None
    except ValueError as error:
        raise ForeignFileError(f"this is not JSON ({error})"[:300]) from None
    return value


def _without_doubles(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        for name, _ in pairs:
            if name not in found:  # taken out when it was met before
                raise ForeignFileError(f"the key {name[:80]!r} occurs twice")
            del found[name]
    return found


def _refuse(word: str) -> float:
    raise ForeignFileError(f"{word} is no number of JSON")


def _finite(word: str) -> float:
    value = float(word)
    if not math.isfinite(value):
        raise ForeignFileError(f"the number {word[:40]} is too large")
    return value


def _whole(word: str) -> int:
    if len(word) > 20 or abs(int(word)) >= _LARGEST_WHOLE:
        raise ForeignFileError(f"the number {word[:40]} is too large")
    return int(word)


def sealed(plain: dict[str, Any]) -> dict[str, Any]:
    """Seals a JSON object: its last field becomes a hash of the others."""
    return {**plain, _SEAL: _seal_of(plain)}


def unsealed(plain: dict[str, Any]) -> dict[str, Any]:
    """Removes the seal of a JSON object after checking it; one without a seal stays as it is.

    Raises:
        ForeignFileError: the seal is not that of the rest.
    """
    if _SEAL not in plain:
        return plain
    rest = {name: value for name, value in plain.items() if name != _SEAL}
    if plain[_SEAL] != _seal_of(rest):
        raise ForeignFileError(
            f"checksum mismatch: the file was damaged or edited; if you edited it, remove its "
            f"`{_SEAL}` field"
        )
    return rest


def _seal_of(plain: dict[str, Any]) -> str:
    text = json.dumps(plain, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


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
        what = (
            f"is missing {', '.join(missing)}"
            if missing
            else f"has an unknown {_short(unknown[0])}"
        )
        raise ForeignFileError(f"the {kind.__name__} {what}")
    hints = typing.get_type_hints(kind)
    for name, value in plain.items():
        if name not in ready:
            check_type(name, value, hints[name])
    return kind(**{**plain, **ready})


def check_fields(name: str, record: Any, kinds: Mapping[str, Any]) -> None:
    """Refuses a JSON object with missing fields or fields of other types; others may be there.

    Raises:
        ForeignFileError: says which field of `name`.
    """
    check_type(name, record, dict[str, Any])
    missing = sorted(kinds.keys() - record.keys())
    if missing:
        raise ForeignFileError(f"`{name[:80]}` is missing {', '.join(missing)}")
    for field, kind in kinds.items():
        check_type(f"{name}.{field}", record[field], kind)


def check_type(name: str, value: Any, hint: Any) -> None:
    """Refuses a value from JSON that is not of a type.

    Raises:
        ForeignFileError: it is not; names the field, the expected type and the found one.
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
    if origin is tuple and args[1:] != (...,):
        is_long = isinstance(value, list) and len(value) == len(args)
        return is_long and all(map(_is, value, args))
    if origin in (list, tuple):
        inner = args[0] if args else Any
        return isinstance(value, list) and all(_is(x, inner) for x in value)
    if dataclasses.is_dataclass(hint):  # as an object with some of its fields
        return _holds_fields(value, typing.get_type_hints(hint))
    if origin is dict:
        return isinstance(value, dict) and all(_is(x, args[1]) for x in value.values())
    if hint is float:
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        return is_number and math.isfinite(value)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(value, types.NoneType if hint is None else hint)


def _holds_fields(value: Any, hints: Mapping[str, Any]) -> bool:
    if not isinstance(value, dict):
        return False
    return all(name in hints and _is(x, hints[name]) for name, x in value.items())


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
