"""JSON without what Python's reader lets through: NaN, doubled keys, endless nesting.

msgspec's reader is stricter than Python's, but lets a doubled key and whole numbers of any length
through, and cannot be told otherwise; Python's has a hook for each.
"""

import hashlib
import json
import math
from typing import Any

from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import plain_text

_SEAL = "seal"

_MAX_PARTS = 4_000_000
"""Values of one text: a list takes 60 bytes of memory, and three of the file."""

_LARGEST_WHOLE = 1 << 63
"""Whole numbers beyond this fit in no array and no float."""


def parse_json(data: bytes | str) -> Any:
    """The value of a JSON text. All its numbers are finite, all its texts can be encoded.

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
    """A JSON object with a seal, a hash of all that it says: its last field."""
    return {**plain, _SEAL: _seal_of(plain)}


def unsealed(plain: dict[str, Any]) -> dict[str, Any]:
    """A JSON object without its seal; one that was never sealed as it is.

    Raises:
        ForeignFileError: the seal is not that of the rest.
    """
    if _SEAL not in plain:
        return plain
    rest = {name: value for name, value in plain.items() if name != _SEAL}
    if plain[_SEAL] != _seal_of(rest):
        raise ForeignFileError(
            f"it was damaged or changed: its `{_SEAL}` is of another content (who changes it by "
            "hand must take that field out)"
        )
    return rest


def _seal_of(plain: dict[str, Any]) -> str:
    text = json.dumps(plain, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
