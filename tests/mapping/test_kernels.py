"""The kernels that map a frame on a CPU, against the plain formulas."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera, look_at
from r3jax.mapping import update
from r3jax.mapping.state import MapState, empty_map
from r3jax.mapping.update import integrate

WIDTH, HEIGHT, CAPACITY = 24, 40, 4096  # one shape: one compile; more rows than a block has
CAMERA = Camera(WIDTH, HEIGHT, 40.0, 44.0, 11.0, 20.5)
REACH = jnp.float32(3.0)

formulas = jax.jit(update._by_formulas)
kernels = jax.jit(update._by_kernels)


def frame_of(seed: int, holes: float = 0.1) -> Frame:
    """A noisy wall with a step, seen from somewhere near the origin; holes and far pixels."""
    random = np.random.default_rng(seed)
    depth = random.uniform(1.0, 1.5) + 0.02 * random.normal(size=(HEIGHT, WIDTH))
    depth[:, WIDTH // 2 :] += random.uniform(0.0, 2.0)
    depth[random.random(depth.shape) < holes] = 0.0
    depth[random.random(depth.shape) < 0.1] = np.inf
    eye, aim = random.normal(size=3) * 0.3, random.normal(size=3) * [1.0, 1.0, 0.3]
    return Frame(
        rgb=random.random((HEIGHT, WIDTH, 3)).astype(np.float32),
        depth=depth.astype(np.float32),
        T_world_camera=look_at(jnp.asarray(eye, jnp.float32), jnp.asarray(eye + aim, jnp.float32)),
        camera=CAMERA,
    )


def assert_same_map(found: MapState, expected: MapState) -> None:
    """The same rows; rounding may put a voxel on the other side of a pixel's edge, now and then."""
    for name in ("key", "count", "dropped"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    np.testing.assert_allclose(found.mean, expected.mean, atol=1e-5)
    np.testing.assert_allclose(found.m2, expected.m2, atol=1e-5)
    same_bins = np.all(np.asarray(found.visited) == np.asarray(expected.visited), axis=0)
    near = np.isclose(found.resolution, expected.resolution, rtol=1e-5)
    assert (same_bins & near).mean() > 0.998


@given(seed=st.integers(0, 10**6), holes=st.sampled_from([0.0, 0.2, 1.0]), edges=st.booleans())
@settings(max_examples=15)
def test_frames_join_as_the_formulas_say(seed, holes, edges):
    found = expected = empty_map(CAPACITY, 0.05, 40)
    for i in range(3):
        frame = frame_of(seed + i, holes)
        found = kernels(found, frame, REACH, jnp.asarray(edges))
        expected = formulas(expected, frame, REACH, jnp.asarray(edges))
    assert holes == 1.0 or int(expected.num_occupied) > 100
    assert_same_map(found, expected)


def test_a_full_table_drops_what_the_formulas_drop():
    found = expected = empty_map(64, 0.05, 40)
    for i in range(2):
        found = kernels(found, frame_of(i), REACH, jnp.asarray(False))
        expected = formulas(expected, frame_of(i), REACH, jnp.asarray(False))
    assert int(expected.dropped) > 100
    np.testing.assert_array_equal(found.dropped, expected.dropped)
    np.testing.assert_array_equal(found.key, expected.key)


def test_an_unsound_pose_adds_nothing_and_poisons_the_map():
    before, frame = kernels(empty_map(CAPACITY), frame_of(0), REACH, jnp.asarray(True)), frame_of(1)
    # A frame refuses such a pose, but not what happens to it under jit.
    skewed = eqx.tree_at(lambda f: f.T_world_camera, frame, 2.0 * frame.T_world_camera)
    after = kernels(before, skewed, REACH, jnp.asarray(True))
    assert np.isnan(float(after.voxel_size))
    np.testing.assert_array_equal(after.key, before.key)
    np.testing.assert_array_equal(after.visited, before.visited)
    again = kernels(after, frame, REACH, jnp.asarray(True))
    np.testing.assert_array_equal(again.key, before.key)


def test_the_public_verb_takes_them_mapped_and_differentiated_forward():
    start, frames = empty_map(CAPACITY), [frame_of(i) for i in range(2)]
    text = jax.jit(integrate).lower(start, frames[0]).as_text()
    assert ("r3jax_map_add" in text) == (jax.default_backend() == "cpu")
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *frames)
    together = jax.vmap(integrate, in_axes=(None, 0))(start, stacked)
    for i, frame in enumerate(frames):
        alone = integrate(start, frame)
        assert_same_map(jax.tree.map(lambda x, i=i: x[i], together), alone)

    def brightness(gain: jax.Array) -> jax.Array:
        frame = frames[0]
        brighter = Frame(frame.rgb * gain, frame.depth, frame.T_world_camera, CAMERA)
        return jnp.sum(integrate(start, brighter).mean)

    _, slope = jax.jvp(brightness, (jnp.float32(0.5),), (jnp.float32(1.0),))
    expected = float(brightness(jnp.float32(1.0)))  # linear in the gain
    np.testing.assert_allclose(slope, expected, rtol=1e-4)
