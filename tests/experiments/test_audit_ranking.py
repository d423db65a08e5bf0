"""The statistics of the comparison of audits with renders."""

import numpy as np
import pytest

from experiments.audit_ranking import (
    corrected_psnr,
    nearness,
    permutation_p,
    shift_p,
    worst_found,
)

RNG = np.random.default_rng(0)


def test_exposure_is_no_error_once_it_is_corrected():
    truth = RNG.integers(60, 160, (20, 30, 3)).astype(np.uint8)
    brighter = np.rint(1.3 * truth.astype(float) + 9).astype(np.uint8)
    assert corrected_psnr(brighter, truth) > 50
    noise = RNG.integers(0, 255, truth.shape).astype(np.uint8)
    assert corrected_psnr(noise, truth) < 20


def test_chance_has_no_small_p_and_order_has():
    x = RNG.normal(size=40)
    assert permutation_p(x, 3 * x + 1) < 0.001
    assert permutation_p(x, -x) > 0.99
    assert shift_p(x, np.exp(x)) == pytest.approx(1 / 40)
    drawn = [permutation_p(RNG.normal(size=12), RNG.normal(size=12)) for _ in range(20)]
    assert 0.25 < np.mean(drawn) < 0.75


def test_the_worst_are_counted_from_below():
    error = np.arange(12.0)
    assert worst_found(error, error) == (3, 3)
    assert worst_found(-error, error) == (0, 3)


def test_nearness_is_that_of_the_nearest_other_camera():
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = [0.0, 1.0, 3.0, 3.5]
    poses[3, :3, :3] = np.diag([-1.0, 1.0, -1.0])  # looks back
    found = nearness(poses, np.array([0, 2]), np.array([1, 3]))
    np.testing.assert_allclose(found, [-1.0, -2.0])
