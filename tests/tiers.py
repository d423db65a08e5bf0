"""Which cases of a parametrized test run in `make test`, in `make test-all`, in `make stress`."""

from collections.abc import Collection, Iterable
from typing import Any

import pytest


def quick_and_full(
    cases: Iterable[Any], quick: Collection[Any], slow: Collection[Any] = ()
) -> list[Any]:
    """Marks every case as `full` but those of `quick` and `slow`, which must be among them."""
    cases = list(cases)
    unknown = [case for case in (*quick, *slow) if case not in cases]
    if unknown:
        raise LookupError(f"{unknown} are not among the cases {cases}")

    def marked(case: Any) -> Any:
        if case in quick:
            return case
        return pytest.param(case, marks=pytest.mark.slow if case in slow else pytest.mark.full)

    return [marked(case) for case in cases]
