"""Faults in the formulas, each of which a test must notice: `make mutants` plants them in turn.

A renamed variable makes a fault stale: `make mutants` names it then, and no other test fails.
"""

from typing import NamedTuple


class Mutant(NamedTuple):
    """One fault, and the test that must fail with it."""

    file: str
    """Of the package, from the repository's root."""

    original: str
    """Source as it stands; occurs exactly once in the file."""

    mutated: str
    """Source with the fault."""

    test: str
    """As pytest names it."""


def faults(file: str, test: str, *changes: tuple[str, str]) -> list[Mutant]:
    """Several faults in one file, all for one test."""
    return [Mutant(file, original, mutated, test) for original, mutated in changes]
