"""The scene is in view in windows of any shape, and the grid lies on the floor."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("viser", reason="the viewer needs viser, which is not installed")

from r3jax.apps.viewer.layout import framing
from r3jax.apps.viewer.run_page import floor_height
from r3jax.geometry.cameras import look_at

FIELD_OF_VIEW = np.deg2rad(35.0)  # of the page, vertical


@given(st.floats(0.3, 3.0), st.tuples(*[st.floats(0.5, 20.0)] * 3))
def test_a_box_fills_a_window_of_any_shape_and_stays_inside(aspect, size):
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * size
    position, target = framing(corners, aspect)
    pose = np.asarray(look_at(position, target), np.float64)
    x, y, z = ((corners - position) @ pose[:3, :3]).T
    half = np.tan(0.5 * FIELD_OF_VIEW)
    across, down = np.abs(x / z).max() / (aspect * half), np.abs(y / z).max() / half
    assert (z > 0.0).all()
    assert max(across, down) <= 1.0
    assert max(across, down) > 0.85


def test_the_floor_is_the_lowest_layer_that_is_well_filled():
    floor, wall = np.full(1000, 0.025), np.repeat(np.arange(0.075, 2.5, 0.05), 40)
    stray, ceiling = np.array([-0.475, -0.275]), np.full(900, 2.525)
    heights = np.concatenate([ceiling, wall, floor, stray])
    assert floor_height(heights, 0.05) == pytest.approx(0.0, abs=1e-6)
    assert floor_height(heights + 1.0, 0.05) == pytest.approx(1.0, abs=1e-6)
