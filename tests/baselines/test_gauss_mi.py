"""GauSS-MI's four reliabilities, its loss and its utility, by hand and by brute force."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r3jax.baselines import gauss_mi
from r3jax.baselines.information import pixel_tallies
from r3jax.baselines.online_map import Seen
from r3jax.geometry.cameras import look_at
from r3jax.splatting.backend import RasterConfig
from tests.splatting.clouds import random_cloud, view

CONFIG = RasterConfig(max_intersections=1 << 12)


def test_sides_by_hand() -> None:
    scene = random_cloud(0, 2, 0)
    position = jnp.zeros(3)
    means = jnp.array([[3.0, -4.0, 12.0], [-1.0, 0.0, 0.0]])
    found = gauss_mi.side_weights(type(scene)(**{**vars(scene), "means": means}), position)
    # u = (3, -4, 12) / 13: to +x and -y; z has no side, and nothing is normalized.
    np.testing.assert_allclose(found[0], [3 / 13, 0.0, 0.0, 4 / 13], rtol=1e-6)
    np.testing.assert_allclose(found[1], [0.0, 0.0, 1.0, 0.0], rtol=1e-6)


def test_evidence_by_hand() -> None:
    """A loss of 0.588 is where belief turns into doubt; 1e-4 is the floor after the factor.

    The photo tells where there is a loss: a map that shows nothing is wrong, a black photo tells
    of nothing.
    """
    rgb = jnp.full((1, 6, 3), 0.9).at[0, 5].set(0.0)
    depth = jnp.array([[2.0, 2.0, 0.0, 2.0, 2.0, 0.0]])
    off = 0.588 / 0.95
    shown = np.array([[0.9 - off] * 3, *[[0.9] * 3] * 3, [0.0] * 3, [0.4] * 3], np.float32)
    distance = jnp.array([[2.0, 2.0, 5.0, 1.0, 0.0, 3.0]])
    seen = Seen(jnp.asarray(shown)[None], distance, jnp.ones((1, 6)))
    found = np.asarray(gauss_mi.evidence(seen, rgb, depth))[0]
    assert found[0] == pytest.approx(-np.log(1.7 * 0.588), abs=1e-5)
    assert abs(found[0]) < 1e-3
    np.testing.assert_allclose(found[1:3], -np.log(1e-4), rtol=1e-6)  # no depth: no depth error
    assert found[3] == pytest.approx(-np.log(1.7 * 0.05), rel=1e-5)
    assert found[4] == pytest.approx(-np.log(1.7 * (0.95 * 0.9 + 0.05 * 2.0)), rel=1e-5)
    assert found[5] == pytest.approx(-np.log(1e-4), rel=1e-6)


def test_belief_by_hand() -> None:
    marks = jnp.array([[0.0, 9.5, -9.5, 0.0]] * 3)
    weights = jnp.array([[0.5, 0.5, 0.0, 0.1]] * 3)
    tallies = jnp.array([[0.1, 5.0], [0.1, 4.0], [-9.0, 9.0]])
    found = np.asarray(gauss_mi.believe(marks, weights, tallies))
    np.testing.assert_allclose(found[0], [0.5, 10.0, -9.5, 0.1], rtol=1e-6)
    np.testing.assert_array_equal(found[1], marks[1])  # touched by four pixels
    # Each step is clipped by itself before the sum is.
    np.testing.assert_allclose(found[2], [-10.0, -0.5, -9.5, -9.0], rtol=1e-5)


def test_utility_is_brute_force() -> None:
    """One Gaussian after the other: its weights in the image times its doubt from that side."""
    module = gauss_mi
    scene, (camera, pose) = random_cloud(5, 12, 0), view(16, 16)
    pose = jnp.asarray(pose)
    marks = jnp.asarray(np.random.default_rng(1).normal(size=(12, 4)) * 3.0, jnp.float32)
    (found,), _ = module._scores(CONFIG, scene, camera, marks, pose[None])
    ones = jnp.ones((16, 16))
    weight, _ = pixel_tallies(scene, camera, pose, ones, ones, CONFIG, source="reference")
    r = np.clip(1.0 / (1.0 + np.exp(-np.asarray(marks, np.float64))), 1e-4, 0.9999)
    offset = np.asarray(scene.means, np.float64) - np.asarray(pose[:3, 3], np.float64)
    u = offset / np.linalg.norm(offset, axis=1, keepdims=True)
    total = 0.0
    for i in range(12):
        x, y = u[i, :2]
        doubt = abs(x) * -np.log(r[i, 0 if x > 0 else 2]) + abs(y) * -np.log(
            r[i, 1 if y > 0 else 3]
        )
        total += float(weight[i, 0]) * doubt
    assert float(found) == pytest.approx(total, rel=1e-4)


def test_novelty_by_hand() -> None:
    novelty = gauss_mi.novelty
    poses = np.stack(
        [np.asarray(look_at(np.array([x, 0.0, 0.0]), np.array([x, 5.0, 0.0]))) for x in range(7)]
    )
    assert novelty(poses[6], poses) == 1.0  # the last pose itself is not asked
    assert novelty(poses[5], poses) == pytest.approx(0.05)
    assert novelty(poses[2], poses) == pytest.approx(1.0 - 0.95**4)
    near = poses[2].copy()
    near[:3, 3] += [0.0, 0.29, 0.0]
    assert novelty(near, poses) == pytest.approx(1.0 - 0.95**4)
    near[:3, 3] += [0.0, 0.02, 0.0]
    assert novelty(near, poses) == 1.0
    turned = np.asarray(look_at(poses[2, :3, 3], poses[2, :3, 3] + [1.0, 5.0, 0.0]))  # 11.3 degrees
    assert novelty(turned, poses) == 1.0
    assert novelty(poses[2], poses[:5]) == 1.0  # five poses: nothing is held back
    assert novelty(poses[1], poses) == pytest.approx(1.0 - 0.95**5)
    assert novelty(poses[0], poses) == 1.0  # the first of all is not asked


def test_reliabilities_start_at_one_half_and_stay_in_their_range():
    r = np.asarray(gauss_mi.reliability(jnp.array([[0.0, 10.0, -10.0, 99.0]])))[0]
    np.testing.assert_allclose(r, [0.5, 0.9999, 1e-4, 0.9999], rtol=1e-4)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 1 << 20))
def test_a_view_is_shared_among_two_sides_at_most(seed):
    scene = random_cloud(seed, 20, 0)
    weights = np.asarray(gauss_mi.side_weights(scene, jnp.array([0.3, -0.2, 0.1])))
    assert np.all(weights >= 0.0)
    assert np.all((weights > 0.0).sum(axis=1) <= 2)
    assert np.all(np.sum(weights**2, axis=1) <= 1.0 + 1e-5)
