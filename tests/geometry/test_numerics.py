"""Values of the safe functions against the plain ones, and gradients where those have none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.geometry.numerics import safe_norm, safe_power

positive = st.floats(2.0**-10, 1.0, width=32)
exponents = st.floats(0.0, 4.0, width=32)

norm = jax.jit(safe_norm)
power = jax.jit(safe_power)
norm_gradient = jax.jit(jax.grad(safe_norm))
power_gradient = jax.jit(jax.grad(safe_power, argnums=(0, 1)))


@given(st.lists(st.floats(-100, 100, width=32), min_size=3, max_size=3))
def test_norm_is_the_length(vector):
    x = np.array(vector, dtype=np.float64)
    x[np.abs(x) < 1e-6] = 0.0  # squares of smaller numbers underflow in float32
    np.testing.assert_allclose(norm(jnp.asarray(x, jnp.float32)), np.linalg.norm(x), rtol=1e-6)


def test_norm_follows_its_axis():
    x = jnp.array([[3.0, 0.0, 1.0], [4.0, 2.0, 0.0]])
    np.testing.assert_allclose(safe_norm(x, axis=0), [5.0, 2.0, 1.0])
    np.testing.assert_allclose(safe_norm(x), [np.sqrt(10.0), np.sqrt(20.0)], rtol=1e-6)


def test_norm_has_gradient_zero_at_the_origin_and_the_direction_elsewhere():
    np.testing.assert_array_equal(norm_gradient(jnp.zeros(3)), np.zeros(3))
    np.testing.assert_allclose(norm_gradient(jnp.array([0.0, 3.0, 4.0])), [0, 0.6, 0.8], rtol=1e-6)


@given(positive, exponents)
def test_power_is_the_plain_power_with_its_gradients(base, exponent):
    x, y = jnp.float32(base), jnp.float32(exponent)
    np.testing.assert_allclose(power(x, y), base**exponent, rtol=1e-5)
    by_base, by_exponent = power_gradient(x, y)
    np.testing.assert_allclose(by_base, exponent * base ** (exponent - 1.0), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(by_exponent, base**exponent * np.log(base), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("exponent", "value"), [(0.0, 1.0), (0.25, 0.0), (0.5, 0.0), (1.0, 0.0), (2.0, 0.0)]
)
def test_power_of_zero_has_a_value_and_finite_gradients(exponent, value):
    zero, exponent = jnp.float32(0.0), jnp.float32(exponent)
    assert float(power(zero, exponent)) == value
    assert np.isfinite(power_gradient(zero, exponent)).all()
