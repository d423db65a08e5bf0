"""The vectors of 16 floats against NumPy."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numba import njit

from r3jax.kernels.splatting import lanes

rows = hnp.arrays(np.float32, 16, elements=st.floats(-100.0, 100.0, width=32))


@njit
def _operate(a, b, c, out):
    x, y, z = lanes.load(a, 0), lanes.load(b, 0), lanes.load(c, 0)
    results = (
        x + y,
        x - y,
        x * y,
        lanes.quotient(x, y * y + 1.0),
        lanes.fma(x, y, z),
        lanes.keep_gt(z, x, y),
        lanes.keep_ge(z, x, y),
        lanes.larger(x, y),
        lanes.smaller(x, y),
        2.0 * x - np.float32(3.0),
        lanes.splat(a[3]) + lanes.lane_numbers(),
        lanes.root(x * x),
        lanes.exp2(lanes.larger(x, lanes.splat(-30.0))),
    )
    k = 0
    for result in results:
        lanes.store(out, k, result)
        k += 16
    return lanes.any_above(x, b[0])


@given(rows, rows, rows)
def test_lanes_are_numpy(a, b, c):
    out = np.empty((13, 16), np.float32)
    above = _operate(a, b, c, out.reshape(-1))
    expected = [
        a + b,
        a - b,
        a * b,
        a / (b * b + 1),
        a.astype(np.float64) * b + c,
        np.where(a > b, c, 0),
        np.where(a >= b, c, 0),
        np.maximum(a, b),
        np.minimum(a, b),
        2 * a - 3,
        a[3] + np.arange(16),
        np.abs(a),
        np.exp2(np.maximum(a, -30).astype(np.float64)),
    ]
    scale = np.abs(a * b) + np.abs(c) + np.abs(a).max() + 16.0  # of the terms that may cancel
    for found, right in zip(out[:-1], expected[:-1], strict=True):
        assert (np.abs(found - right) <= 1e-6 * scale).all()
    np.testing.assert_allclose(out[-1], expected[-1], rtol=4e-7)
    assert above == (a > b[0]).any()


@njit
def _sums(values, out):
    total = lanes.sums_of_10(
        lanes.load(values, 0),
        lanes.load(values, 16),
        lanes.load(values, 32),
        lanes.load(values, 48),
        lanes.load(values, 64),
        lanes.load(values, 80),
        lanes.load(values, 96),
        lanes.load(values, 112),
        lanes.load(values, 128),
        lanes.load(values, 144),
    )
    lanes.store12(out, 2, total)


@settings(max_examples=20)
@given(hnp.arrays(np.float32, (10, 16), elements=st.floats(-100.0, 100.0, width=32)))
def test_sums_of_ten_vectors(values):
    out = np.full(20, 7.0, np.float32)
    _sums(values.reshape(-1), out)
    np.testing.assert_allclose(out[2:12], values.sum(axis=1, dtype=np.float64), atol=2e-3)
    assert (out[:2] == 7.0).all()  # nothing is written beside the 12 floats
    assert (out[14:] == 7.0).all()


def test_what_is_not_a_number_is_not_kept():
    a = np.where(np.arange(16) % 2 == 0, np.nan, 1.0).astype(np.float32)
    out = np.empty((13, 16), np.float32)
    zero, one = np.zeros(16, np.float32), np.ones(16, np.float32)
    _operate(a, zero, one, out.reshape(-1))
    kept = np.where(np.isnan(a), 0.0, 1.0)
    np.testing.assert_array_equal(out[5], kept)  # greater
    np.testing.assert_array_equal(out[6], kept)  # greater or equal
    np.testing.assert_array_equal(out[7], np.where(np.isnan(a), 0.0, 1.0))  # the second, 0
    np.testing.assert_allclose(out[12][np.isnan(a)], 2.0**-30, rtol=1e-6)
