"""The packed mip pyramids hold what they were given."""

import numpy as np
import pytest

from r3jax.simulators.raycast.shading_tables import MAX_LEVELS, build_atlas, mip_levels

RNG = np.random.default_rng(1)


def image(height, width):
    return RNG.integers(0, 256, (height, width, 3), dtype=np.uint8)


def unpacked(atlas, index, level):
    width, height = np.maximum(atlas.sizes[index] >> level, 1)
    start = atlas.offsets[index, level]
    texels = atlas.texels[start : start + width * height]
    channels = [(texels >> shift) & 255 for shift in (0, 8, 16)]
    return np.stack(channels, axis=-1).reshape(height, width, 3)


@pytest.mark.parametrize("size", [(8, 8), (5, 12), (1, 7), (33, 2)])
def test_every_level_can_be_read_back(size):
    images = [image(3, 4), image(*size)]
    atlas = build_atlas(images)
    for level, expected in enumerate(mip_levels(images[1])):
        np.testing.assert_array_equal(unpacked(atlas, 1, level), expected)


def test_levels_shrink_to_one_texel_that_is_the_mean():
    source = image(64, 64)
    levels = mip_levels(source)
    assert [level.shape[0] for level in levels] == [64, 32, 16, 8, 4, 2, 1]
    np.testing.assert_allclose(levels[-1][0, 0], source.mean(axis=(0, 1)), atol=2.0)


def test_levels_beyond_the_last_repeat_it():
    atlas = build_atlas([image(4, 4)])
    assert (atlas.offsets[0, 2:] == atlas.offsets[0, 2]).all()
    assert atlas.offsets.shape[1] == MAX_LEVELS


def test_a_world_without_textures_has_an_atlas():
    atlas = build_atlas([])
    assert atlas.texels.shape == (0,)
    assert atlas.sizes.shape == (0, 2)
