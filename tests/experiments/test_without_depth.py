"""Ranks of audits without depth against audits with it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.without_depth import ranks


@given(seed=st.integers(0, 99), size=st.integers(5, 40))
def test_ranks_do_not_change_where_values_are_bent(seed, size):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(2, size))
    value, low, high = ranks(a, b)
    assert low <= high
    assert ranks(np.exp(a), b**3)[0] == pytest.approx(value)
    assert ranks(a, -b)[0] == pytest.approx(-value)
    assert ranks(a, a)[0] == pytest.approx(1.0)
