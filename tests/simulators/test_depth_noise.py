"""The noise has the promised spread, and the same pose gives the same frame."""

import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.simulators.base import NoisySimulator, Simulator

CAMERA = Camera.from_fov(200, 100, 60.0)


class Flat:
    """A wall at 2 m, with a stripe without measurement and one out of range."""

    camera = CAMERA
    bounds = np.array([[0.0, 0, 0], [1, 1, 1]])
    start_pose = np.eye(4)

    def render(self, T_world_camera):
        depth = np.full((100, 200), 2.0, np.float32)
        depth[:10], depth[10:20] = 0.0, np.inf
        rgb = jnp.full((100, 200, 3), 0.5)
        return Frame(rgb, jnp.asarray(depth), jnp.asarray(T_world_camera, jnp.float32), CAMERA)


def shifted(x):
    pose = np.eye(4)
    pose[0, 3] = x
    return pose


def test_spread_is_a_share_of_the_depth():
    depth = np.asarray(NoisySimulator(Flat(), 0.01).render(np.eye(4)).depth)[20:]
    assert abs(depth.mean() - 2.0) < 1e-3
    assert abs(depth.std() - 0.02) < 1e-3


def test_holes_and_out_of_range_keep_their_meaning():
    depth = np.asarray(NoisySimulator(Flat(), 0.2).render(np.eye(4)).depth)
    assert (depth[:10] == 0.0).all()
    assert np.isinf(depth[10:20]).all()
    assert (depth[20:] > 0.0).all()


def test_noise_depends_on_the_pose_and_the_seed_only():
    noisy = NoisySimulator(Flat(), 0.01, seed=3)
    first = np.asarray(noisy.render(shifted(0.0)).depth)
    other_pose = np.asarray(noisy.render(shifted(0.1)).depth)
    again = np.asarray(noisy.render(shifted(-0.0)).depth)
    fresh = np.asarray(NoisySimulator(Flat(), 0.01, seed=3).render(shifted(0.0)).depth)
    other_seed = np.asarray(NoisySimulator(Flat(), 0.01, seed=4).render(shifted(0.0)).depth)
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(first, fresh)
    assert (first[20:] != other_pose[20:]).mean() > 0.9
    assert (first[20:] != other_seed[20:]).mean() > 0.9


def test_everything_else_passes_through():
    inner = Flat()
    noisy = NoisySimulator(inner)
    assert isinstance(noisy, Simulator)
    assert noisy.camera is CAMERA
    np.testing.assert_array_equal(noisy.bounds, inner.bounds)
    np.testing.assert_array_equal(noisy.start_pose, inner.start_pose)
    np.testing.assert_array_equal(noisy.render(np.eye(4)).rgb, inner.render(np.eye(4)).rgb)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"relative_sigma": -0.1}, "relative_sigma"),
        ({"relative_sigma": float("nan")}, "relative_sigma"),
        ({"relative_sigma": 1.0}, "relative_sigma"),
        ({"seed": -1}, "seed"),
    ],
)
def test_settings_out_of_range_are_named(settings, words):
    with pytest.raises(ValueError, match=words):
        NoisySimulator(Flat(), **settings)
