"""Packing over the whole signed range, and indices on both sides of zero."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given

from r3jax.geometry.voxels import (
    EMPTY_WORD,
    INDEX_LIMIT,
    check_near_origin,
    pack,
    unpack,
    voxel_center,
    voxel_index,
)
from tests.strategies import NUM_TRIPLES, index_triples

pack_rows = jax.jit(lambda index: jnp.stack(pack(*index)))
unpack_rows = jax.jit(lambda words: jnp.stack(unpack(words[0], words[1])))

CORNER = np.full((3, NUM_TRIPLES), -INDEX_LIMIT, dtype=np.int32)
OTHER_CORNER = np.full((3, NUM_TRIPLES), INDEX_LIMIT - 1, dtype=np.int32)


@given(index_triples())
@example(CORNER)
@example(OTHER_CORNER)
def test_unpacking_undoes_packing(index):
    np.testing.assert_array_equal(unpack_rows(pack_rows(jnp.asarray(index))), index)


@given(index_triples())
@example(CORNER)
@example(OTHER_CORNER)
def test_packed_words_are_one_number_of_three_fields(index):
    low, high = np.asarray(pack_rows(jnp.asarray(index))).astype(object)
    x, y, z = index.astype(object) + INDEX_LIMIT
    expected = x + (y << 21) + (z << 42)
    assert (low + (high << 32) == expected).all()
    assert (high < 1 << 31).all()
    assert (high != EMPTY_WORD).all()


@pytest.mark.parametrize("size", [0.0625, 0.05])
def test_index_is_the_floor_also_below_zero(size):
    index = np.arange(-40, 40)
    inside = (index[:, None] + np.array([0.01, 0.5, 0.99])) * size
    found = voxel_index(jnp.asarray(inside, jnp.float32), jnp.float32(size))
    np.testing.assert_array_equal(found, np.broadcast_to(index[:, None], (80, 3)))


def test_voxel_zero_spans_zero_to_size():
    edges = jnp.array([-0.0625, -1e-6, -0.0, 0.0, 0.0624, 0.0625])
    found = voxel_index(edges, jnp.float32(0.0625))
    np.testing.assert_array_equal(found, [-1, -1, 0, 0, 0, 1])


def test_center_lies_in_the_middle_of_its_voxel():
    index = jnp.arange(-30, 30, dtype=jnp.int32)
    center = voxel_center(index, jnp.float32(0.05))
    np.testing.assert_allclose(center, (np.arange(-30, 30) + 0.5) * 0.05, rtol=1e-6)
    np.testing.assert_array_equal(voxel_index(center, jnp.float32(0.05)), index)


def test_index_stops_at_the_limits_of_the_world():
    far = jnp.array([-1e30, -1e7, 1e7, 1e30])
    found = np.asarray(voxel_index(far, jnp.float32(0.05)))
    np.testing.assert_array_equal(found, [-INDEX_LIMIT] * 2 + [INDEX_LIMIT - 1] * 2)


@pytest.mark.parametrize("value", [-32769.0, 5e5, 1e30, np.inf])
def test_what_float32_cannot_hold_to_a_millimeter_is_refused(value):
    points = np.zeros((4, 3))
    check_near_origin("bounds", points + 32768.0)
    points[2, 1] = value
    with pytest.raises(ValueError, match=r"bounds.*origin"):
        check_near_origin("bounds", points)


def test_an_origin_is_suggested_for_utm():
    with pytest.raises(ValueError, match=r"such as \[500000\.0, -5600000\.0, 0\.0\]"):
        check_near_origin("position", np.array([500_123.4, -5_599_876.5, 112.0]))
