"""Sentences of an audit: numbers as exact as they are, and no more."""

from types import SimpleNamespace

import pytest

from r3jax.apps.audit.pages.sentences import area

pytestmark = pytest.mark.full


@pytest.mark.parametrize(
    ("square_units", "said"),
    [(2.0, "2.0 m²"), (1.949, "1.9 m²"), (0.0123, "0.012 m²"), (76.4, "76 m²"), (1234.0, "1200 m²")],
)
def test_an_area_has_two_digits(square_units, said):
    survey = SimpleNamespace(length=lambda value: value, unit="m")
    assert area(SimpleNamespace(survey=survey), square_units) == said
