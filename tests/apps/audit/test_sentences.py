"""Sentences of an audit: numbers as exact as they are, and no more."""

import pytest

from r3jax.apps.audit.sentences import two_digits


@pytest.mark.parametrize(
    ("value", "said"),
    [(2.0, "2.0"), (1.949, "1.9"), (0.0123, "0.012"), (9.96, "10"), (76.4, "76"), (1234.0, "1200")],
)
def test_an_area_has_two_digits(value, said):
    assert two_digits(value) == said
