"""Budgets: what is written is what is meant, and nonsense is refused."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.exploration.config import Budget, parse_budget


@given(st.sampled_from(["seconds", "metres"]), st.floats(0.01, 1e6))
def test_the_text_of_a_budget_reads_back(unit, amount):
    assert parse_budget(f"{unit}:{amount}") == Budget(unit, amount)
    assert parse_budget(str(Budget(unit, amount))) == Budget(unit, amount)


def test_meters_are_spelled_as_here_or_as_in_files():
    assert parse_budget("meters:25") == parse_budget("metres:25")
    assert str(parse_budget("meters:25")) == "metres:25"
    assert parse_budget("metres:25").words == "25 meters"
    assert parse_budget("frames:25").words == "25 frames"


NONSENSE = """
views | views: | 100 | views:0 | views:-3 | views:2.5 | seconds:nan | metres:inf | minutes:3
| views:ten | :5 | views:1:2
"""


@pytest.mark.parametrize("text", ["", *(text.strip() for text in NONSENSE.split("|"))])
def test_nonsense_is_refused_with_an_example(text):
    with pytest.raises(ValueError, match="budget") as caught:
        parse_budget(text)
    assert "views" in str(caught.value)
    assert "frames:" in str(caught.value)


def test_a_budget_limits_its_own_unit_only():
    budget = parse_budget("seconds:300")
    assert budget.allows(views=10**6, frames=10**6, seconds=300.0, metres=1e9)
    assert not budget.allows(views=1, frames=1, seconds=300.01, metres=0.0)
    assert budget.spent_share(views=0, frames=0, seconds=150.0, metres=0.0) == 0.5
    assert str(budget) == "seconds:300"
