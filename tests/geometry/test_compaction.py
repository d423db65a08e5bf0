"""Running counts and compaction against NumPy, over sizes around the blocks' borders."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.geometry import selection as compaction
from r3jax.geometry.selection import positions_of_set, running_count

SIZES = [1, 2, 63, 64, 65, 4095, 4097, 64**3 + 5]


def flags_of(size: int, density: float) -> np.ndarray:
    return np.random.default_rng(size).random(size) < density


@pytest.mark.parametrize("size", SIZES)
def test_running_count_is_cumsum(size):
    count = jax.jit(running_count)
    for density in (0.0, 0.03, 0.5, 1.0):
        flags = flags_of(size, density)
        np.testing.assert_array_equal(count(jnp.asarray(flags)), np.cumsum(flags))


@pytest.mark.parametrize("size", SIZES)
def test_positions_are_nonzero_in_order_then_padding(size):
    room = max(1, size // 3)
    positions = jax.jit(positions_of_set, static_argnums=1)
    for density in (0.0, 0.03, 0.5, 1.0):
        flags = flags_of(size, density)
        expected = np.flatnonzero(flags)[:room]
        expected = np.pad(expected, (0, room - len(expected)), constant_values=size)
        np.testing.assert_array_equal(positions(jnp.asarray(flags), room), expected)


def test_more_room_than_flags_is_padded():
    np.testing.assert_array_equal(positions_of_set(jnp.array([False, True]), 4), [1, 2, 2, 2])


def test_counts_that_float32_cannot_hold_are_refused():
    too_many = jax.ShapeDtypeStruct((1 << 24,), jnp.bool_)
    with pytest.raises(ValueError, match="16777216"):
        jax.eval_shape(running_count, too_many)


# Laws of fixed examples ---------------------------------------------------------------------------


def test_law_holds_without_a_fault() -> None:
    for size in (64, 4097):
        flags = flags_of(size, 0.5)
        np.testing.assert_array_equal(
            compaction.running_count(jnp.asarray(flags)), np.cumsum(flags)
        )
        positions = compaction.positions_of_set(jnp.asarray(flags), 20)
        np.testing.assert_array_equal(positions, np.flatnonzero(flags)[:20])
    few = compaction.positions_of_set(jnp.array([False, True, False]), 4)
    np.testing.assert_array_equal(few, [1, 3, 3, 3])
