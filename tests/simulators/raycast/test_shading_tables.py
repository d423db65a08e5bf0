"""The packed mip pyramids hold what they were given."""

import numpy as np
import pytest

from r3jax.simulators.raycast.shading_tables import MAX_LEVELS, build_atlas

RNG = np.random.default_rng(1)


def image(height, width):
    return RNG.integers(0, 256, (height, width, 3), dtype=np.uint8)


def unpacked(atlas, index, level):
    width, height = np.maximum(atlas.sizes[index] >> level, 1)
    start = atlas.offsets[index, level]
    texels = atlas.texels[start : start + width * height]
    channels = [(texels >> shift) & 255 for shift in (0, 8, 16)]
    return np.stack(channels, axis=-1).reshape(height, width, 3)


def halved(level):
    """Means of 2x2 texels, halves up; a single row or column is there twice."""
    height, width = (max(n // 2, 1) for n in level.shape[:2])
    rows = np.minimum(np.arange(2 * height), level.shape[0] - 1)
    columns = np.minimum(np.arange(2 * width), level.shape[1] - 1)
    blocks = level[rows][:, columns].astype(float).reshape(height, 2, width, 2, 3)
    return np.floor(blocks.mean(axis=(1, 3)) + 0.5)


@pytest.mark.parametrize("size", [(8, 8), (5, 12), (1, 7), (33, 2), (1, 1), (64, 64)])
def test_every_level_is_the_rounded_mean_of_the_one_before(size):
    images = [image(3, 4), image(*size), image(2, 5)]
    atlas = build_atlas(images)
    expected, level = images[1], 0
    np.testing.assert_array_equal(unpacked(atlas, 1, 0), expected)
    while max(expected.shape[:2]) > 1:
        expected, level = halved(expected), level + 1
        np.testing.assert_array_equal(unpacked(atlas, 1, level), expected)
    np.testing.assert_array_equal(unpacked(atlas, 2, 0), images[2])


def test_nothing_stands_between_the_levels():
    shapes = [(3, 4), (1, 7)]
    atlas = build_atlas([image(*shape) for shape in shapes])
    assert len(atlas.texels) == (12 + 2 + 1) + (7 + 3 + 1)


def test_levels_beyond_the_last_repeat_it():
    atlas = build_atlas([image(4, 4)])
    assert (atlas.offsets[0, 2:] == atlas.offsets[0, 2]).all()
    assert atlas.offsets.shape[1] == MAX_LEVELS


def test_a_world_without_textures_has_an_atlas():
    atlas = build_atlas([])
    assert atlas.texels.shape == (0,)
    assert atlas.sizes.shape == (0, 2)
