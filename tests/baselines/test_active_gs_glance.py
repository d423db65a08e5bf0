"""Active-GS's sightings of voxels that no pixel touched: voxel by voxel in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.baselines import confidence
from r3jax.baselines.confidence import aligned, glance, no_sightings, see
from r3jax.geometry.voxels import unpack, voxel_center
from r3jax.mapping.occupancy import empty_grid
from r3jax.mapping.seen import rows_in_view
from r3jax.planning.registry import make_policy
from tests.baselines.test_active_gs_confidence import RANGE, frames, maps

pytestmark = pytest.mark.full

REACH = jnp.float32(RANGE)


def history():
    """Per frame after the first: frame, map, sightings before it and after its pixels."""
    seen, steps = no_sightings(), []
    for frame, state in zip(frames(), maps(), strict=True):
        before = aligned(seen, state)
        seen = see(before, state, frame, REACH)
        steps.append((frame, state, before, seen))
    return steps[1:]


def test_glances_are_what_a_loop_says() -> None:
    numbers = []
    in_float64 = lambda x: np.asarray(x, dtype=np.float64)
    for frame, state, before, touched in history():
        after = confidence.glance(before, touched, state, frame, REACH)
        seen = np.asarray(rows_in_view(state, frame, REACH))
        is_touched = np.asarray(touched.views) > np.asarray(before.views)
        known = np.asarray(touched.views) > 0
        rows = np.flatnonzero(seen & known & ~is_touched)
        numbers.append(len(rows))
        centers = in_float64(
            voxel_center(jnp.stack(unpack(state.key[0], state.key[1])), state.voxel_size)
        )
        views = in_float64(touched.views).copy()
        cosines = in_float64(touched.cosine_sum).copy()
        directions = in_float64(touched.direction_sum).copy()
        for row in rows:
            offset = in_float64(frame.position) - centers[:, row]
            distance = np.linalg.norm(offset)
            normal = in_float64(touched.normal_sum)[:, row]
            cosine = normal @ offset / np.linalg.norm(normal) / distance
            views[row] += 1
            cosines[row] += max(0.0, 1.0 - distance / RANGE) * max(0.0, cosine)
            directions[:, row] += offset / distance
        np.testing.assert_array_equal(after.views, views)
        np.testing.assert_allclose(after.cosine_sum, cosines, atol=2e-5)
        np.testing.assert_allclose(after.direction_sum, directions, atol=2e-5)
        np.testing.assert_array_equal(after.normal_sum, touched.normal_sum)
        np.testing.assert_array_equal(after.key, touched.key)
    assert sum(numbers) > 10


def test_a_look_may_raise_confidence_but_never_the_cosines_of_what_is_hidden():
    frame, state, before, touched = history()[-1]
    after = glance(before, touched, state, frame, REACH)
    hidden = ~np.asarray(rows_in_view(state, frame, REACH))
    assert hidden.any()
    np.testing.assert_array_equal(
        np.asarray(after.cosine_sum)[hidden], np.asarray(touched.cosine_sum)[hidden]
    )
    assert np.all(np.asarray(after.cosine_sum) >= np.asarray(touched.cosine_sum))


def test_the_policy_takes_note_of_pixels_and_glances():
    policy = make_policy("active-gs")
    grid = empty_grid(np.array([[-1.0, -2.0, 0.0], [4.0, 2.0, 2.0]]), 0.2)
    state = policy.init(frames()[0].camera, grid, key=jax.random.key(0))
    expected = no_sightings()
    for frame, known in zip(frames(), maps(), strict=True):
        state = policy.observe(state, known, frame)
        before = aligned(expected, known)
        touched = see(before, known, frame, REACH)
        expected = glance(before, touched, known, frame, REACH)
    jax.tree.map(np.testing.assert_array_equal, state.memory, expected)
    assert float(expected.views.sum()) > float(history()[-1][3].views.sum()) + 10
