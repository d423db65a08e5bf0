"""Frames of a video: sharp ones, within equal motion."""

import numpy as np
import pytest
from scipy import ndimage

from r3jax.apps.select.video import choose_from, sharpest_of_equal_motion, shift_between, small_gray


def scene(seed: int = 0) -> np.ndarray:
    """A wide picture of blobs, [120, 900, 3] uint8."""
    rng = np.random.default_rng(seed)
    noise = ndimage.gaussian_filter(rng.normal(size=(120, 900)), 2.0)
    gray = 127 + 100 * noise / np.abs(noise).max()
    return np.repeat(gray[..., None], 3, axis=2).astype(np.uint8)


@pytest.mark.parametrize("pixels", [0, 3, 11, -7])
def test_a_shift_is_measured(pixels):
    wide = scene()
    first, second = (small_gray(wide[:, x : x + 160]) for x in (200, 200 + pixels))
    assert shift_between(first, second) == pytest.approx(abs(pixels) / 160, abs=0.5 / 160)


def test_pictures_of_different_things_count_as_far_apart():
    first, second = (small_gray(scene(seed)[:, :160]) for seed in (1, 2))
    assert shift_between(first, second) > 0.2


def test_a_camera_that_stands_still_leaves_few_frames():
    wide = scene()
    places = [0] * 30 + [8 * i for i in range(1, 31)]  # half a minute still, then a pan
    found = choose_from((wide[:, x : x + 160] for x in places), 10)
    assert len(found.chosen) == 10
    assert (found.chosen < 30).sum() <= 2


def test_of_each_stretch_the_sharpest_is_taken():
    motion = np.full(40, 0.01)
    sharpness = np.ones(40)
    sharpness[[3, 17, 26, 38]] = 2.0
    assert sharpest_of_equal_motion(motion, sharpness, 4).tolist() == [3, 17, 26, 38]


def test_as_many_frames_come_as_were_asked_for_or_as_there_are():
    rng = np.random.default_rng(0)
    motion, sharpness = rng.exponential(0.02, 25), rng.random(25)
    motion[10] = 0.9  # a cut
    for num in (1, 7, 25, 99):
        chosen = sharpest_of_equal_motion(motion, sharpness, num)
        assert len(chosen) == min(num, 25) == len(set(chosen.tolist()))
