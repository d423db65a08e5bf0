"""Arithmetic with gradients that stay finite at singular points."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def safe_norm(x: Float[Array, "..."], axis: int = -1) -> Float[Array, "..."]:
    """Computes the Euclidean length along `axis`; its gradient at the zero vector is 0, not NaN."""
    squared = jnp.sum(x * x, axis=axis)
    is_zero = squared == 0.0
    # Replaced before the root, not after: the gradient of sqrt at 0 is infinite, and times the
    # zero of the branch not taken that is NaN.
    squared_safe = jnp.where(is_zero, 1.0, squared)
    return jnp.where(is_zero, 0.0, jnp.sqrt(squared_safe))


def safe_power(base: Float[Array, "..."], exponent: Float[Array, "..."]) -> Float[Array, "..."]:
    """Computes `base ** exponent` for `base >= 0` and `exponent >= 0`, with `0 ** 0 = 1`.

    At base 0 the plain gradient is infinite for exponents below 1 (and for the exponent's own
    `log(0)`). Here both gradients are 0 there: the value is the constant 0 (or 1) nearby in
    every direction that the callers can move.
    """
    # Rounding may leave a base just below 0, whose logarithm is NaN.
    is_zero = base <= 0.0
    base_safe = jnp.where(is_zero, 1.0, base)
    # With log 1 = 0 the branch not taken has finite gradients in both arguments.
    power = jnp.exp(exponent * jnp.log(base_safe))
    at_zero = jnp.where(exponent == 0.0, 1.0, 0.0)
    return jnp.where(is_zero, at_zero, power)
