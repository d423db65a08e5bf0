"""Which cases of a parametrized test run in `make test`, and which in `make test-all` alone."""

from collections.abc import Collection, Iterable
from typing import Any

import pytest


def quick_and_full(cases: Iterable[Any], quick: Collection[Any]) -> list[Any]:
    """Marks every case as `full` but those of `quick`, which must be among them."""
    cases = list(cases)
    unknown = [case for case in quick if case not in cases]
    if unknown:
        raise LookupError(f"{unknown} are not among the cases {cases}")
    return [case if case in quick else pytest.param(case, marks=pytest.mark.full) for case in cases]
