"""The online Gaussian map: where Gaussians are born, what trains them, what goes."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from r3jax.baselines import online_map
from r3jax.baselines.online_map import (
    BALLS,
    DISCS,
    FIRST_CAPACITY,
    FIRST_ERROR,
    GAUSS_MI,
    _added,
    _gradient_of_view,
    _pruned,
    _stepped,
    add_frame,
    colored,
    drawn_batch,
    empty_online_map,
    grown,
    kept_rows,
    one_per_voxel,
    rows_in_view,
    show,
    supported_by,
    turned_to,
)
from r3jax.exploration.state import compilations
from r3jax.geometry.cameras import Camera, pose_along
from r3jax.splatting.backend import RasterConfig
from r3jax.splatting.projection import rotation_rows
from r3jax.splatting.render import render
from r3jax.splatting.training.optimizer import empty_moments
from tests.exploration.toys import BoxRoom
from tests.splatting.clouds import random_cloud
from tests.tiers import quick_and_full

KEY = jax.random.key(5)


def room_frames(num: int):
    """A walk through the box room, turning."""
    room = BoxRoom()
    for step in range(num):
        place = jnp.array([1.2 + 0.2 * step, 1.1, 1.3])
        toward = jnp.array([np.cos(0.2 * step), np.sin(0.2 * step), 0.0], jnp.float32)
        yield room.render(np.asarray(pose_along(place, toward), np.float64))


def mapped(settings, num: int):
    online = None
    for frame in room_frames(num):
        online = online or empty_online_map(frame.camera, settings, KEY)
        online = add_frame(online, frame, 5.0, settings)
    return online


def color_error(online, number: int) -> float:
    seen = show(online.scene, online.camera, online.frames.T_world_camera[number])
    return float(np.abs(np.asarray(seen.rgb) - online.frames.rgb[number] / 255.0).mean())


SETTINGS = {"discs": DISCS, "balls": BALLS, "gauss-mi": GAUSS_MI}


@pytest.mark.parametrize("name", quick_and_full(SETTINGS, ["discs"]))
def test_the_map_shows_what_it_was_shown_and_twice_the_same(name):
    settings = SETTINGS[name]
    online, again = mapped(settings, 6), mapped(settings, 6)
    for a, b in zip(jax.tree.leaves(online), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))
    assert color_error(online, 5) < 0.25
    assert online.num_gaussians > 1000
    assert np.all(online.frames.error < FIRST_ERROR)
    alive = np.asarray(online.scene.is_alive)
    assert alive[: online.num_gaussians].all()  # rows in use come first
    sizes = np.exp(np.asarray(online.scene.log_scales)[alive])
    assert sizes.max() <= settings.max_size * 1.0001
    if settings.flat:
        np.testing.assert_allclose(sizes[:, 2], 1e-5, rtol=1e-3)


@pytest.mark.full
def test_training_lessens_the_error_of_what_was_born():
    untrained = mapped(replace(DISCS, steps=0), 3)
    assert color_error(mapped(replace(DISCS, steps=40, rate_opacities=0.05), 3), 2) < 0.8 * (
        color_error(untrained, 2)
    )


def test_frames_compile_nothing_once_the_first_are_in():
    frames, settings = list(room_frames(6)), replace(DISCS, image_width=32, steps=2, prune_every=2)
    online = empty_online_map(frames[0].camera, settings, KEY)
    before = []
    for frame in frames:
        before.append(compilations.count)
        online = add_frame(online, frame, 5.0, settings)
    assert online.scene.capacity == FIRST_CAPACITY
    assert before[1] > before[0]
    # Each frame has births, drawn frames and rows of its own.
    assert compilations.count == before[3]


def test_the_rows_in_view_have_the_whole_gradient():
    settings = replace(GAUSS_MI, image_width=32)
    online = mapped(replace(settings, steps=2), 3)
    num, capacity = online.num_gaussians, online.scene.capacity
    sizes = []
    for number in range(3):
        frame = jax.tree.map(lambda x, number=number: x[number], online.frames)
        means = np.asarray(online.scene.means)[:num]
        some = rows_in_view(means, online.camera, frame.T_world_camera, settings)
        found = []
        for rows in (np.arange(capacity), np.pad(some, (0, 9), constant_values=capacity)):
            (part, error), _ = _gradient_of_view(
                RasterConfig(), online.scene, online.camera, frame, rows.astype(np.int32), settings
            )
            nothing = jax.tree.map(jnp.zeros_like, online.scene)
            found.append((_added(nothing, part, rows.astype(np.int32)), error))
        for a, b in zip(*map(jax.tree.leaves, found), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6 * float(jnp.abs(a).max()))
        assert float(jnp.abs(found[0][0].means).max()) > 0.0
        sizes.append(len(some))
    assert max(sizes) < num  # not all of them


@hypothesis_settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 1 << 20), field=st.floats(40.0, 110.0))
def test_no_row_out_of_view_has_a_gradient_wherever_training_moves_it(seed, field):
    rng = np.random.default_rng(seed)
    camera = Camera.from_fov(24, 16, field)
    pose = np.asarray(pose_along(jnp.zeros(3), jnp.asarray(rng.normal(size=3), jnp.float32)))
    scene = random_cloud(seed, 400, 0)
    # All directions, mostly near: where a ball reaches far across the image's edge.
    means = rng.normal(size=(400, 3)) * rng.uniform(0.02, 1.5, (400, 1))
    shift = rng.normal(size=(400, 3))
    shift *= GAUSS_MI.rate_means * GAUSS_MI.steps / np.abs(shift).max(axis=1, keepdims=True)
    sizes = jnp.full((400, 3), np.log(GAUSS_MI.max_size))
    moved = eqx.tree_at(
        lambda s: (s.means, s.log_scales, s.opacity_logits), scene,
        (jnp.asarray(means + shift, jnp.float32), sizes, jnp.full(400, 9.0)),
    )  # fmt: skip

    def brightness(scene):
        seen = render(scene, camera, jnp.asarray(pose))
        return seen.rgb.sum() + seen.alpha.sum()

    gradient = jax.grad(brightness)(moved)
    has_one = np.asarray(sum(jnp.abs(x.reshape(400, -1)).sum(1) for x in jax.tree.leaves(gradient)))
    rows = rows_in_view(means.astype(np.float32), camera, pose, GAUSS_MI)
    assert set(np.flatnonzero(has_one)) <= set(rows)
    assert len(rows) < 400


def test_a_batch_is_the_latest_frames_and_earlier_ones_by_their_error():
    rng = np.random.default_rng(0)
    assert drawn_batch(np.full(2, 1.0), DISCS, rng) == [0, 1]
    error = np.array([0.0, 5.0, 0.0, 5.0, 5.0, 0.0, 5.0, 5.0, 1.0, 1.0, 1.0])
    for _ in range(20):
        batch = drawn_batch(error, DISCS, rng)
        assert batch[:3] == [8, 9, 10]
        assert sorted(batch[3:]) == [1, 3, 4, 6, 7]  # those of error 0 are not drawn
    # GauSS-MI draws its two earlier ones whatever their errors.
    drawn = [drawn_batch(np.append(np.zeros(4), np.ones(9)), GAUSS_MI, rng) for _ in range(60)]
    assert all(batch[:8] == list(range(5, 13)) for batch in drawn)
    assert {number for batch in drawn for number in batch[8:]} == {0, 1, 2, 3, 4}


def test_sizes_are_evened_out_beside_the_sum_of_the_losses():
    """Where the losses have no gradient, what is left is that of the unevenness, by batch."""
    scene = random_cloud(0, 6, 0)
    nothing = jax.tree.map(jnp.zeros_like, scene)

    def unevenness(log_scales):
        sizes = jnp.exp(log_scales)
        return jnp.mean(jnp.abs(sizes - sizes.mean(axis=1, keepdims=True)))

    slope = jax.grad(unevenness)(scene.log_scales)
    assert float(jnp.abs(slope).max()) > 1e-3
    for num in (1, 10):
        _, moments = _stepped(scene, empty_moments(scene), nothing, num, GAUSS_MI)
        # Adam's first moment: a tenth of the gradient.
        np.testing.assert_allclose(moments.mean.log_scales, slope / num, rtol=1e-4, atol=1e-8)


def test_what_no_key_frame_sees_any_more_is_pruned():
    online = mapped(DISCS, 4)
    scene, seen = online.scene, np.zeros(online.scene.capacity, dtype=bool)
    for number in range(4):
        seen |= supported_by(online, number)
    gone, faint = np.flatnonzero(seen)[[5, 9]]
    # The one is now behind all cameras, which look along +x and turn by 0.6; the other is faint.
    means = scene.means.at[gone].set(jnp.array([-50.0, 0.0, 0.0]))
    logits = scene.opacity_logits.at[faint].set(-4.0)
    changed = eqx.tree_at(lambda s: (s.means, s.opacity_logits), scene, (means, logits))
    online = replace(online, scene=changed)
    expected = np.asarray(scene.is_alive) & np.asarray(jax.nn.sigmoid(logits) >= 0.1)
    expected &= np.any([supported_by(online, number) for number in range(4)], axis=0)
    assert not expected[[gone, faint]].any()
    pruned = _pruned(online, DISCS)
    assert pruned.num_gaussians == expected.sum() > 1000
    kept = np.asarray(pruned.scene.means)[: pruned.num_gaussians]
    np.testing.assert_array_equal(kept, np.asarray(means)[expected])


def test_births_by_hand() -> None:
    """Each of the three reasons just beyond its threshold, and just short of it."""
    rgb, depth = np.full((1, 6, 3), 0.5, np.float32), np.full((1, 6), 2.0, np.float32)
    # The mean of the three channels: one that is off by 0.7 is not enough.
    color = rgb + np.array([0.501, 0.499, 0, 0, 0, 0])[None, :, None]
    color[0, 5, 0] += 0.7
    distance = np.array([[2.0, 2.0, 2.0, 2.0, 2.11, 2.09]])
    alpha = np.array([[1.0, 1.0, 0.49, 0.51, 1.0, 1.0]])
    found = online_map.is_wrong(rgb, depth, (color, distance, alpha), DISCS)
    assert found.tolist() == [[True, False, True, False, True, False]]


def test_discs_lie_on_their_wall() -> None:
    """A slanted wall: Gaussians on its pixels' points, their third axes along its normal."""
    camera = Camera.from_fov(24, 20, 70.0)
    pose = np.asarray(pose_along(jnp.array([1.0, 2.0, 0.5]), jnp.array([1.0, 0.1, 0.0])))
    normal, height = np.array([-0.9, 0.3, 0.2]), -3.0
    normal /= np.linalg.norm(normal)
    u = (np.arange(24) + 0.5 - float(camera.cx)) / float(camera.fx)
    v = (np.arange(20) + 0.5 - float(camera.cy)) / float(camera.fy)
    rays = np.stack([*np.meshgrid(u, v), np.ones((20, 24))], axis=-1) @ pose[:3, :3].T
    depth = ((height - pose[:3, 3] @ normal) / (rays @ normal)).astype(np.float32)
    depth[3, 5] = 0.0
    rgb = np.random.default_rng(0).integers(0, 256, (20, 24, 3)).astype(np.uint8)
    nothing = np.zeros((20, 24, 3)), np.zeros((20, 24)), np.zeros((20, 24))
    settings = replace(DISCS, spacing=1e-3)
    rng = np.random.default_rng(0)
    born = online_map.born_in(rgb, depth, pose, camera, nothing, settings, rng)
    assert len(born.means) == 20 * 24 - 1
    np.testing.assert_allclose(born.means @ normal, height, atol=1e-4)
    rotation = rotation_rows(jnp.asarray(born.quats))
    axis = np.stack([np.asarray(rotation[i][2]) for i in range(3)], axis=1)
    # At the border and beside the hole a slope has no pair of neighbors.
    inner = np.zeros((20, 24), dtype=bool)
    inner[1:-1, 1:-1] = True
    inner[2:5, 4:7] = False
    inner = inner[depth > 0.0]
    np.testing.assert_allclose(axis[inner], np.tile(normal, (inner.sum(), 1)), atol=2e-3)
    np.testing.assert_allclose(born.colors[0], rgb[0, 0] / 255.0, atol=1e-6)
    np.testing.assert_allclose(np.exp(born.log_scales[0]), [0.01, 0.01, 1e-5], rtol=1e-4)


def test_rows_move_whole() -> None:
    scene = random_cloud(1, 6, 0)
    marks = jnp.arange(12.0).reshape(6, 2) + 1.0
    keep = np.array([False, True, True, False, True, False])
    kept, moved = online_map.kept_rows((scene, marks), keep)
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        a, b = np.asarray(getattr(kept, name)), np.asarray(getattr(scene, name))
        np.testing.assert_array_equal(a[:3], b[keep])
    np.testing.assert_array_equal(moved, [[3, 4], [5, 6], [9, 10], [0, 0], [0, 0], [0, 0]])
    assert np.asarray(kept.is_alive).tolist() == [True] * 3 + [False] * 3


def test_a_map_grows_by_unused_rows():
    scene, marks = grown((random_cloud(1, 6, 0), jnp.ones((6, 2))), 16)
    assert scene.capacity == 16
    assert int(scene.is_alive.sum()) == 6
    assert float(marks.sum()) == 12.0
    back, _ = kept_rows((scene, marks), np.asarray(scene.is_alive))
    for a, b in zip(jax.tree.leaves(back), jax.tree.leaves(scene), strict=True):
        np.testing.assert_array_equal(a, b)


@hypothesis_settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 1 << 20), spacing=st.floats(0.02, 1.0))
def test_one_point_is_drawn_for_each_voxel(seed, spacing):
    rng = np.random.default_rng(seed)
    points, index = rng.uniform(-1, 1, (80, 3)), np.flatnonzero(rng.random(80) < 0.7)
    chosen = one_per_voxel(points, index, spacing, rng)
    assert set(chosen) <= set(index)
    voxels = [tuple(v) for v in np.floor(points[chosen] / spacing).astype(int)]
    assert len(set(voxels)) == len(voxels)
    assert set(voxels) == {tuple(v) for v in np.floor(points[index] / spacing).astype(int)}


@hypothesis_settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 1 << 20))
def test_quaternions_turn_the_z_axis_to_normals(seed):
    normals = np.random.default_rng(seed).normal(size=(5, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[0] = (0.0, 0.0, -1.0)
    rotation = rotation_rows(jnp.asarray(turned_to(normals), jnp.float32))
    axis = np.stack([np.asarray(rotation[i][2]) for i in range(3)], axis=1)
    np.testing.assert_allclose(axis, normals, atol=1e-5)


def test_values_are_composited_by_their_weights():
    scene = mapped(DISCS, 1)
    pose = scene.frames.T_world_camera[0]
    seen = show(colored(scene.scene, jnp.full(scene.scene.capacity, 0.25)), scene.camera, pose)
    np.testing.assert_allclose(seen.rgb[..., 0], 0.25 * np.asarray(seen.alpha), atol=1e-5)
