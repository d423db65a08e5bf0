"""The confidence of Active-GS on its own map, and its utility, by hand and by brute force."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r3jax.baselines import active_gs_online
from r3jax.baselines.online_map import Seen, turned_to
from r3jax.geometry.cameras import Camera, pose_along
from r3jax.kernels.calls import Cells
from tests.splatting.clouds import random_cloud

RANGE = jnp.float32(5.0)


def discs(means, normals):
    """Discs at places that face along unit vectors."""
    scene = random_cloud(0, len(means), 0)
    quats = jnp.asarray(turned_to(np.asarray(normals, float)), jnp.float32)
    return replace(scene, means=jnp.asarray(means, jnp.float32), quats=quats)


def test_confidence_by_hand() -> None:
    """One look from 3 m; the same look again; one from the side; edge-on; from behind; too far."""
    module = active_gs_online
    scene = discs([[0, 0, 0]] * 3, [[0, 0, 1], [0, 0, 1], [1, 0, 0]])
    here, marks = jnp.array([0.0, 0.0, 3.0]), jnp.zeros((3, 5))
    marks = module.support(marks, scene, here, jnp.array([True, False, True]), RANGE)
    np.testing.assert_allclose(module.confidence(marks), [0.4, 0.0, 0.0], atol=1e-6)
    assert marks[2, 0] == 1.0  # seen edge-on: supported, of no weight
    # From 4 m, 60 degrees aside: weight 0.2 x 0.5; the mean direction is cos 30 degrees long.
    aside = jnp.array([2.0 * np.sqrt(3.0), 0.0, 2.0])
    marks = module.support(marks, scene, aside, jnp.array([True, True, False]), RANGE)
    expected = [np.exp(1.0 - np.cos(np.pi / 6.0)) * 0.5, 0.1]
    np.testing.assert_allclose(module.confidence(marks)[:2], expected, rtol=1e-5)
    behind, far = jnp.array([0.0, 0.0, -1.0]), jnp.array([0.0, 0.0, 7.0])
    for place in (behind, far):
        later = module.support(marks, scene, place, jnp.array([True] * 3), RANGE)
        assert float(later[0, 4]) == pytest.approx(0.5)
    # Many good looks: no more than 1.
    for _ in range(5):
        marks = module.support(marks, scene, here, jnp.array([True] * 3), RANGE)
    assert float(module.confidence(marks)[0]) == 1.0


def test_utility_by_hand() -> None:
    """Nothing there: 2.5 m in doubt. Beyond range: believed. Else (1 - C) depth."""
    depth = jnp.array([[0.0005, 6.0, 2.0, 4.0]])
    believed = jnp.array([[0.3, 0.0, 0.25, 1.0]])
    seen = Seen(jnp.stack([believed] * 3, axis=-1), depth, jnp.ones((1, 4)))
    found = active_gs_online.rendering_utility(seen, RANGE)
    assert float(found) == pytest.approx((2.5 + 0.0 + 0.75 * 2.0 + 0.0) / 5.0 / 4.0)


def test_cells_are_counted_one_by_one() -> None:
    rng = np.random.default_rng(2)
    camera = Camera(9, 7, 8.0, 8.0, 4.0, 3.8)
    pose = np.asarray(pose_along(jnp.array([0.2, -0.1, 0.4]), jnp.array([1.0, 0.3, -0.1])))
    points = rng.uniform(-7.0, 7.0, (20000, 3)).astype(np.float32)
    unexplored = rng.random(20000) < 0.8
    depth = rng.choice([0.0, 1.5, 3.0, 8.0], (7, 9)).astype(np.float32)
    T = np.linalg.inv(pose.astype(np.float64))
    expected = 0
    for point, is_open in zip(points, unexplored, strict=True):
        x, y, z = T[:3, :3] @ point + T[:3, 3]
        if not is_open or z <= 0.0:
            continue
        column, row = int(np.floor(8.0 * x / z + 4.0)), int(np.floor(8.0 * y / z + 3.8))
        if 0 <= column < 9 and 0 <= row < 7:
            known = depth[row, column]
            expected += z < (5.0 if known < 1e-3 else min(known, 5.0))
    seen = Seen(jnp.zeros((7, 9, 3)), jnp.asarray(depth), jnp.ones((7, 9)))
    cells = Cells(*(jnp.asarray(points[:, i]) for i in range(3)), jnp.asarray(unexplored))
    found = active_gs_online.cells_in_sight(cells, camera, jnp.asarray(pose), seen, RANGE)
    assert expected > 50
    assert float(found) == expected


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 1 << 20), looks=st.integers(1, 6))
def test_confidence_is_a_share_and_grows_with_every_look_from_one_place(seed, looks):
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(8, 3))
    scene = discs(rng.normal(size=(8, 3)), normals / np.linalg.norm(normals, axis=1)[:, None])
    marks, before = jnp.zeros((8, 5)), np.zeros(8)
    place = jnp.asarray(rng.normal(size=3) * 2.0, jnp.float32)
    for _ in range(looks):
        marks = active_gs_online.support(marks, scene, place, jnp.ones(8, dtype=bool), RANGE)
        now = np.asarray(active_gs_online.confidence(marks))
        assert np.all((now >= before - 1e-6) & (now <= 1.0))
        before = now
