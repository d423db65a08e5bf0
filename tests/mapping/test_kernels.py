"""The kernels that map a frame on a CPU, against the plain formulas."""

import functools
from unittest import mock

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera, look_at
from r3jax.kernels import calls
from r3jax.kernels.native import platform
from r3jax.mapping import update
from r3jax.mapping.seen import hidden_by_none, mark_rows, rows_in_view
from r3jax.mapping.state import MapState, empty_map
from r3jax.mapping.update import integrate
from tests.plain_kernels import Modules, kernels_as_python, load

WIDTH, HEIGHT, CAPACITY = 24, 40, 4096  # one shape: one compile; more rows than a block has
CAMERA = Camera(WIDTH, HEIGHT, 40.0, 44.0, 11.0, 20.5)
REACH = jnp.float32(3.0)
CHAIN = tuple(f"r3jax.kernels.mapping.{name}" for name in ("bins", "mark", "add"))

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


# ---------------------------------------------------------------------------------------- laws


@functools.cache
def asked(third: int = 2, reach: float = 3.0, drops: bool = True):
    """A map of two frames, a third one, and the map that the formulas make of both.

    Number 0 was there before; from 3 cm farther off some of its voxels are in the map, others not.
    """
    state = empty_map(CAPACITY, 0.05, 40)
    for i in range(2):
        state = formulas(state, frame_of(i), REACH, jnp.asarray(True))
    frame = frame_of(third)
    farther = jnp.where(frame.depth > 0, frame.depth + 0.03, 0.0)
    frame = eqx.tree_at(lambda f: f.depth, frame, farther if third < 2 else frame.depth)
    added = jax.jit(update.integrate_pixels)(state, frame, jnp.float32(reach), jnp.asarray(drops))
    return state, frame, added


def arrays_of(state: MapState) -> calls.MapRows:
    rows = state.rows
    return calls.MapRows(*map(np.array, rows[:-1]), np.float32(state.voxel_size))


def image_of(frame: Frame, reach: float | jax.Array, drops: bool = True) -> calls.FrameArrays:
    image = update.for_kernels(frame, jnp.float32(reach), jnp.asarray(drops))
    return calls.FrameArrays(*(np.float32(part) for part in image))


def law_add(modules: Modules) -> None:
    for third in (2, 0):
        check_add(modules, third)
    depth = np.asarray(frame_of(2).depth)
    check_add(modules, 2, float(np.median(depth[np.isfinite(depth) & (depth > 0)])))
    check_add(modules, 2, np.inf, drops=False)
    before, after = (np.asarray(asked(0)[k].count) for k in (0, 2))
    assert ((after > before) & (before > 0)).sum() > 20
    assert ((after > before) & (before == 0)).sum() > 20


def check_add(modules: Modules, third: int, reach: float = 3.0, *, drops: bool = True) -> None:
    state, frame, expected = asked(third, reach, drops)
    rows, mean, lost = arrays_of(state), np.array(state.mean), np.zeros(1, np.int32)
    with kernels_as_python():
        modules["add"].map_add(
            rows, mean, image_of(frame, reach, drops), *calls._bins(state.num_bins), 2, lost
        )
    assert lost[0] == 0
    for found, wanted in zip((*rows, mean), (*expected.rows, expected.mean), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-5)


def law_mark(modules: Modules) -> None:
    _, frame, state = asked()
    check_mark(modules, *comb(frame), REACH)
    rows = np.asarray(state.center).T[np.asarray(state.occupied)]
    near = np.quantile(np.linalg.norm(rows - np.asarray(frame.position), axis=-1), 0.7)
    for reach in (REACH, jnp.float32(near)):
        check_mark(modules, state, frame, reach)


def comb(frame: Frame) -> tuple[MapState, Frame]:
    """A map and a frame with teeth of a pixel: beside each lies what is farther."""
    teeth = np.where(np.asarray(frame.depth) > 0, 1.2 + 0.4 * (np.arange(WIDTH) % 2), 0.0)
    frame = eqx.tree_at(lambda f: f.depth, frame, jnp.asarray(teeth, jnp.float32))
    # Seen from beside itself: its points then lie between the pixels.
    beside = frame.T_world_camera.at[:3, 3].add(0.02 * frame.T_world_camera[:3, 0])
    moved = eqx.tree_at(lambda f: f.T_world_camera, frame, beside)
    state = formulas(empty_map(CAPACITY, 0.05, 40), moved, REACH, jnp.asarray(False))
    return state, frame


def check_mark(modules: Modules, state: MapState, frame: Frame, reach: jax.Array) -> None:
    """The rows that the formula finds are marked as the formula marks them."""
    # As if nothing had been seen from anywhere, so that every mark shows.
    blank = jnp.zeros_like(state.visited), jnp.zeros_like(state.resolution)
    state = eqx.tree_at(lambda m: (m.visited, m.resolution), state, blank)
    # By the formulas: kernels are not compiled while they are Python.
    with mock.patch.object(platform, "can_call_kernels", return_value=False):
        is_visible = np.asarray(jax.jit(hidden_by_none)(state, frame, reach))
        shown = jax.jit(rows_in_view)(state, frame, reach)
    expected = mark_rows(state, shown, frame.position, CAMERA.focal)
    visited, resolution = np.array(state.visited), np.array(state.resolution)
    with kernels_as_python():
        modules["mark"].map_mark(
            visited, resolution, np.array(state.key), np.float32(state.voxel_size),
            image_of(frame, reach), is_visible.astype(np.uint8), *calls._bins(state.num_bins), 2,
        )  # fmt: skip
    assert np.asarray(shown).sum() > 50
    # Rounding may put a voxel on the other side of a pixel's edge, now and then.
    assert np.mean((visited == np.asarray(expected.visited)).all(axis=0)) > 0.998
    assert np.mean(np.isclose(resolution, expected.resolution, rtol=1e-5)) > 0.998


def law_nearest_bin(modules: Modules) -> None:
    """The nearest of all bins, also where the best is the last of a cell's candidates."""
    table, lattice = calls._bins(64)
    size = np.float32(np.sqrt(len(table)))
    directions = np.random.default_rng(0).normal(size=(3000, 3))
    directions = (directions / np.linalg.norm(directions, axis=1)[:, None]).astype(np.float32)
    place = np.zeros(table.shape[1], int)
    with kernels_as_python():
        bins = modules["bins"]
        for x, y, z in directions:
            cell = bins.fold(x, y, z, size)
            found = bins.nearest_bin(x, y, z, cell, table, lattice)
            cosines = lattice @ np.array([x, y, z])
            assert cosines[found] >= cosines.max() - 1e-6
            place[np.flatnonzero(table[np.uint32(cell)] == found)[0]] += 1
    assert place[:3].min() > 1


@pytest.mark.parametrize("law", [law_add, law_mark, law_nearest_bin])
def test_laws_hold_for_the_kernels_as_python(law):
    with kernels_as_python():
        law(load(CHAIN))
