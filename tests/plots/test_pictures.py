"""Pictures of a map: colors and directions where they are; thumbnails: up is up."""

import io

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from r3jax.geometry.cameras import Camera, pose_along
from r3jax.mapping.occupancy import empty_grid
from r3jax.mapping.state import empty_map
from r3jax.mapping.update import integrate_points
from r3jax.plots.pictures import floor_picture, panorama_picture, small_png

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


def paint(points, colors):
    state = empty_map(1 << 10, voxel_size=0.1)
    return integrate_points(state, jnp.asarray(points), jnp.asarray(colors), jnp.array([5.0] * 3))


def test_the_floor_picture_puts_colors_where_they_are():
    grid = empty_grid(np.array([[0.0, 0.0, 0.0], [2.0, 1.0, 2.0]]), 0.2)
    free = np.zeros(grid.log_odds.shape, np.float32)
    free[: free.shape[0] // 2] = -4.0
    grid = eqx.tree_at(lambda g: g.log_odds, grid, jnp.asarray(free))
    red, green, blue = np.eye(3, dtype=np.float32)
    points = np.array([[1.55, 0.25, 0.15], [1.55, 0.25, 0.75], [0.45, 0.65, 1.95]], np.float32)
    picture, extent = floor_picture(paint(points, np.stack([red, green, blue])), grid, 1.0)
    left, right, bottom, top = extent
    assert (left, bottom) == pytest.approx((-0.2, -0.2))
    assert picture.shape == (round((top - bottom) / 0.1), round((right - left) / 0.1), 3)
    at = lambda x, y: picture[int((y - bottom) / 0.1), int((x - left) / 0.1)]
    np.testing.assert_allclose(at(1.55, 0.25), green, atol=1e-6)  # the higher one hides the lower
    assert at(0.45, 0.65).min() > 0.95  # the ceiling is cut away; free space is white
    assert at(1.95, 0.85).max() < 0.92  # unexplored is gray


def test_the_panorama_picture_shows_directions():
    angles = np.deg2rad([0.0, 90.0, 180.0, -90.0])
    around = np.stack([np.cos(angles), np.sin(angles), np.zeros(4)], axis=1) * 2.0
    grid = np.stack(np.meshgrid(*[np.arange(-2, 3) * 0.1] * 3), -1).reshape(-1, 3)
    points = (around[:, None] + grid[None]).reshape(-1, 3).astype(np.float32)
    colors = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0]], np.float32)
    state = paint(points, colors.repeat(len(grid), axis=0))
    pose = np.asarray(pose_along(jnp.zeros(3), jnp.array([0.0, 1.0, 0.0])))
    # Known to be free but for a slab overhead: 1 m up begins what was never seen.
    space = empty_grid(np.array([[-6.0] * 3, [6.0] * 3]), 0.2)
    heights = np.asarray(space.origin)[2] + 0.2 * np.arange(space.log_odds.shape[2])
    odds = np.broadcast_to(np.where(heights < 1.0, -4.5, 0.0), space.log_odds.shape)
    space = eqx.tree_at(lambda g: g.log_odds, space, jnp.asarray(odds, jnp.float32))
    picture = panorama_picture(state, space, Camera.from_fov(64, 64), pose, 5.0)
    height, width = picture.value.shape
    column = {angle: int((180.0 - angle) / 360.0 * width) for angle in (0, 90, -90)}
    for angle, color in ((0, colors[0]), (90, colors[1]), (-90, colors[3])):
        np.testing.assert_allclose(picture.rgb[height // 2, column[angle]], color, atol=1e-6)
    np.testing.assert_allclose(picture.rgb[height // 2, 2], colors[2], atol=1e-6)
    assert np.isnan(picture.value[5, 5])  # nothing overhead
    assert not picture.beyond[5, 5]  # nor is that known to be free
    assert picture.beyond[height // 2, column[0] + 30]  # free space up to the range
    assert not picture.beyond[height // 2, column[0]]  # a voxel
    assert 0.0 <= picture.value[height // 2, column[0]] <= 1.0
    assert picture.azimuth == pytest.approx(np.pi / 2)
    assert picture.elevation == pytest.approx(0.0)


def test_the_floor_picture_of_huge_cells_stays_small():
    grid = empty_grid(np.array([[0.0] * 3, [3000.0] * 3]), 1000.0)
    picture, extent = floor_picture(empty_map(64, voxel_size=0.05), grid, 1.0)
    assert max(picture.shape) <= 2048
    assert extent[1] - extent[0] >= 3000.0
