"""Tables of numbers in text files, as most recordings keep their poses."""

import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from r3jax.formats.errors import FormatError, naming
from r3jax.formats.validation.files import read_bytes

_MAX_TEXT = 64 << 20
"""A pose takes some hundred bytes."""


def read_lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """The words of every line that has any, and its number from 1; comments start with #.

    Raises:
        FormatError: missing, not a regular file, or far too large.
    """
    with naming(path):
        data = read_bytes(path, _MAX_TEXT)
    for number, raw in enumerate(io.BytesIO(data), start=1):
        words = raw.decode("utf-8", errors="replace").partition("#")[0].split()
        if words:
            yield number, words


def to_floats(path: Path, number: int, words: list[str], columns: int) -> list[float]:
    """The numbers of one line.

    Raises:
        FormatError: another number of words, or one that is no number.
    """
    if len(words) != columns:
        raise FormatError(path, f"line {number} has {len(words)} numbers, not {columns}")
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise FormatError(path, f"line {number}: {error!s:.200}") from None


def read_numbers(path: Path, columns: int) -> np.ndarray:
    """A table of numbers, [n, columns] float64, n >= 1.

    Raises:
        FormatError: the file is missing, holds no numbers, or a line has another number of them.
    """
    rows = [to_floats(path, number, words, columns) for number, words in read_lines(path)]
    if not rows:
        raise FormatError(path, "the file holds no numbers")
    return np.asarray(rows)
