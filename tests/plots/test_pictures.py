"""Small pictures: whatever way a camera was held, up is up."""

import io

import numpy as np
import pytest
from PIL import Image

from r3jax.plots.pictures import small_png

pytestmark = pytest.mark.full


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_a_small_picture_is_turned_until_up_is_up(quarters):
    """A phone held sideways writes its pictures lying down."""
    angle = np.pi / 2 * quarters
    roll = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    pose = np.eye(4)
    pose[:3, :3] = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], float) @ roll
    upright = np.zeros((40, 60, 3), np.uint8)
    upright[:10] = 255  # the sky
    # Turning the camera clockwise turns what it sees the other way.
    rgb = np.rot90(upright, quarters)
    with Image.open(io.BytesIO(small_png(rgb, pose, np.array([0.0, 0.0, 1.0]), 60))) as small:
        assert np.array_equal(np.asarray(small), upright)
