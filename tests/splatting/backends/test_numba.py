"""The numba rasterizer alone: fewer harmonics, moves of the camera, wild numbers, its lists."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.geometry.cameras import Camera
from r3jax.splatting.backends import numba
from r3jax.splatting.scene import GaussianScene
from tests.splatting.backends.agreement import (
    ALL,
    CONFIG,
    COUNT,
    SIZE,
    assert_agrees,
    gradients_with,
    render_with,
    weighted_sum,
)
from tests.splatting.clouds import random_cloud, view


@pytest.mark.parametrize(
    "degree", [0, *(pytest.param(degree, marks=pytest.mark.slow) for degree in (1, 2))]
)
def test_fewer_harmonics_agree(degree):
    assert_agrees(numba.rasterize, 3, random_cloud(3, COUNT, degree), *view(*SIZE))


def test_pose_gradient_is_a_difference_quotient():
    """Moves of the camera along its axes; the Gaussians are broad, so that cut-offs hardly show."""
    scene, (camera, pose) = random_cloud(6, COUNT), view(*SIZE)
    scene = dataclasses.replace(scene, log_scales=jnp.full((COUNT, 3), -1.0))
    columns = jnp.linspace(-1.0, 1.0, SIZE[0])[None, :, None] * jnp.ones((SIZE[1], SIZE[0], 3))
    weights = columns, jnp.ones(SIZE[::-1]), jnp.zeros(SIZE[::-1])

    @jax.jit
    def loss(shift):
        moved = pose.at[:3, 3].add(pose[:3, :3] @ shift)
        return weighted_sum(weights, numba.rasterize, scene, camera, moved)

    gradient, step = jax.grad(loss)(jnp.zeros(3)), 0.01
    for axis in range(3):
        shift = jnp.zeros(3).at[axis].set(step)
        quotient = (float(loss(shift)) - float(loss(-shift))) / (2.0 * step)
        assert abs(quotient - float(gradient[axis])) < 0.02 * float(jnp.linalg.norm(gradient))


@given(st.integers(0, 10_000))
def test_wild_numbers_are_survived(seed):
    """Infinite, huge and tiny parameters: nothing is read or written where it should not be."""
    scene, (camera, pose) = random_cloud(seed, COUNT), view(*SIZE)
    rng = np.random.default_rng(seed)
    wild = np.array([np.inf, -np.inf, 1e38, -1e38, 1e19, -1e9, 88.0, -88.0, 1e-38, 0.0])

    def spoil(leaf):
        values = np.where(rng.uniform(size=leaf.shape) < 0.1, rng.choice(wild, leaf.shape), leaf)
        return jnp.asarray(values, dtype=jnp.float32)

    spoiled = jax.tree.map(spoil, scene)
    result = render_with(numba.rasterize, spoiled, camera, pose)
    alpha = np.asarray(result.alpha)
    assert 0.0 <= alpha.min() <= alpha.max() <= 1.0 + 1e-5
    jax.block_until_ready(gradients_with(ALL, numba.rasterize, (spoiled, camera, pose)))


def test_with_too_little_room_nothing_is_drawn():
    scene, (camera, pose) = random_cloud(8, COUNT), view(*SIZE)
    short = dataclasses.replace(CONFIG, max_intersections=100)
    assert float(render_with(numba.rasterize, scene, camera, pose, None, short).alpha.max()) == 0.0
    variables = (scene, camera, pose)
    for leaf in jax.tree.leaves(gradients_with(ALL, numba.rasterize, variables, short)):
        assert float(jnp.abs(leaf).max()) == 0.0


def test_intersections_are_the_tiles_that_a_gaussian_touches():
    camera = Camera(64, 48, 50.0, 50.0, 32.0, 24.0)
    pose = jnp.eye(4)

    def needed(scale: float, x: float) -> int:
        scene = GaussianScene(
            means=jnp.asarray([[x, 0.0, 1.0]]),
            quats=jnp.asarray([[1.0, 0.0, 0.0, 0.0]]),
            log_scales=jnp.full((1, 3), jnp.log(scale)),
            opacity_logits=jnp.full(1, 2.0),
            sh=jnp.zeros((1, 1, 3)),
        )
        return int(render_with(numba.rasterize, scene, camera, pose).num_intersections)

    assert needed(0.001, 0.16) == 1  # 8 pixels right of the middle, in the middle of a tile
    assert needed(10.0, 0.0) == 12
    assert needed(0.001, 100.0) == 0
