"""Blur and exposure as the formulas take them."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy import ndimage

from r3jax.apps.select.quality import exposures, fineness, quality_of, with_quality
from r3jax.captures.faults.faults import BLURRED
from tests.apps.select.made_up import observed_of
from tests.captures.faults.walk import blocks, walk
from tests.conftest import shared_path


@given(st.integers(0, 200))
def test_gains_of_channels_are_found_again(seed):
    rng = np.random.default_rng(seed)
    observed = observed_of(seed, frames=8, rows=600)
    surfaces = rng.uniform(0.2, 0.6, (600, 3)).astype(np.float32)
    gains = rng.uniform(0.8, 1.3, (8, 3))
    plain = with_colors(observed, surfaces[observed.row])
    changed = with_colors(observed, plain.color * gains[observed.frame].astype(np.float32))
    found = exposures(changed)
    # Only ratios are known: the median frame has 1.
    np.testing.assert_allclose(found / np.median(found, 0), gains / np.median(gains, 0), rtol=0.05)
    fitted = with_quality(changed, np.ones(8), found)
    apart = lambda seen: np.log(seen.color / plain.color)[seen.is_colored]
    spread = lambda seen: np.std(apart(seen) - apart(seen).mean(axis=0))
    assert spread(fitted) < 0.2 * spread(changed)


def with_colors(observed, color):
    return dataclasses.replace(observed, color=color)


def test_blur_divides_the_resolution():
    observed = observed_of(0)
    blur = np.linspace(1.0, 3.0, len(observed))
    found = with_quality(observed, blur, np.ones((len(observed), 3)))
    np.testing.assert_allclose(found.resolution * blur[observed.frame], observed.resolution, 1e-5)


def test_a_frame_that_was_blurred_is_blurred_and_its_neighbors_are_not():
    pictures = list(walk())
    rgb, depth, pose = pictures[7]
    kernel = np.ones(9) / 9.0
    smeared = np.apply_along_axis(lambda line: np.convolve(line, kernel, "same"), 1, rgb)
    pictures[7] = np.rint(smeared).astype(np.uint8), depth, pose
    fine = [fineness(rgb) for rgb, _, _ in pictures]
    found = quality_of(blocks(pictures), fine, observed_of(0, frames=len(pictures)))
    assert not found.is_soft
    assert found.is_blurred.tolist() == [i == 7 for i in range(len(pictures))]
    assert found.blur[7] > 1.0 / np.sqrt(BLURRED)


@pytest.mark.parametrize("recording", ["hololens_lounge", "banana"])
def test_real_pictures_are_fine_and_no_longer_when_all_are_blurred(recording):
    paths = sorted(shared_path("recordings", recording).glob("images/*"))[::6]
    thinned = lambda path: np.asarray(Image.open(path).convert("RGB"))[::2, ::2]
    found = {
        width: np.median([fineness(ndimage.uniform_filter(thinned(path), (width, width, 1)))
                          for path in paths])
        for width in (1, 5)
    }  # fmt: skip
    assert found[5] < 0.2 < found[1]


def test_tiny_and_plain_pictures_are_not_called_soft():
    assert fineness(np.zeros((12, 12, 3), np.uint8)) == 1.0
    assert fineness(np.full((90, 120, 3), 200, np.uint8)) == 1.0
