"""Seen pixels: a wall by hand, any poses against float64, faults put in on purpose."""

import jax.numpy as jnp
import numpy as np

from experiments import seen_pixels
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera, pose_along
from r3jax.splatting.views import PosedImage

SIZE = 24
CAMERA = Camera.from_fov(SIZE, SIZE, 90.0)
WALL = 2.0  # x of the wall [m]


def look(position, direction=(1.0, 0.0, 0.0)):
    return pose_along(jnp.asarray(position, jnp.float32), jnp.asarray(direction, jnp.float32))


def frame(pose, depth):
    depth = jnp.broadcast_to(jnp.asarray(depth, jnp.float32), (SIZE, SIZE))
    return Frame(jnp.full((SIZE, SIZE, 3), 0.5), depth, pose, CAMERA)


def view(pose, depth):
    depth = jnp.broadcast_to(jnp.asarray(depth, jnp.float32), (SIZE, SIZE))
    return PosedImage(jnp.full((SIZE, SIZE, 3), 0.5), depth, pose, CAMERA)


def asked():

    def seen(test, frames, max_range=5.0):
        limits = jnp.float32(max_range), jnp.float32(0.05)
        return np.asarray(seen_pixels.seen_pixels(test, seen_pixels.recorded(frames), *limits))

    return seen


def test_wall() -> None:
    """Seen is what a frame has looked at.

    The frame stands 1 m to the left: it sees the wall's points with y in [-1, 3].
    """
    seen = asked()
    test = view(look((0.0, 0.0, 0.0)), WALL)
    frames = [frame(look((0.0, 1.0, 0.0)), WALL)]
    y = -WALL * (np.arange(SIZE) + 0.5 - SIZE / 2) / (SIZE / 2)  # the image's x points to -y
    np.testing.assert_array_equal(seen(test, frames), np.tile(y > -1.0, (SIZE, 1)))
    # Two frames see what one or the other sees.
    assert seen(test, [*frames, frame(look((0.0, -1.0, 0.0)), WALL)]).all()
    # One that looks away sees nothing, not even the point straight behind it.
    half = WALL / SIZE
    behind = view(look((0.0, half, half)), WALL)
    assert not seen(behind, [frame(look((0.0, 0.0, 0.0), (-1.0, 0.0, 0.0)), WALL)]).any()


def test_hidden() -> None:
    """What stands before the wall hides it; the sensor's noise does not."""
    seen = asked()
    test = view(look((0.0, 0.0, 0.0)), WALL)
    for depth, expected in ((WALL - 0.2, False), (WALL - 0.04, True), (WALL + 0.3, True)):
        assert np.all(seen(test, [frame(look((0.0, 0.0, 0.0)), depth)]) == expected)
    # A measurement that a neighbor has suffices: on a slope the depth changes within a pixel.
    depth = np.full((SIZE, SIZE), 1.0)
    depth[10, 10] = WALL
    expected = np.zeros((SIZE, SIZE), bool)
    expected[9:12, 9:12] = True
    np.testing.assert_array_equal(seen(test, [frame(look((0.0, 0.0, 0.0)), depth)]), expected)


def test_holes() -> None:
    """Without a depth, here or there, or beyond the range, nothing is seen."""
    seen = asked()
    here = look((0.0, 0.0, 0.0))
    holes = np.full((SIZE, SIZE), WALL)
    holes[:, :5], holes[:, 5:9] = 0.0, np.inf
    whole = [frame(here, WALL)]
    np.testing.assert_array_equal(seen(view(here, holes), whole), holes == WALL)
    assert not seen(view(here, 0.04), [frame(here, 0.0)]).any()  # no measurement, nothing seen
    distance = WALL * np.linalg.norm(
        np.stack(np.meshgrid(*[(np.arange(SIZE) + 0.5 - SIZE / 2) / (SIZE / 2)] * 2)), axis=0
    )
    reach = np.sqrt(distance**2 + WALL**2)
    np.testing.assert_array_equal(seen(view(here, WALL), whole, max_range=2.5), reach <= 2.5)


def test_any_poses_against_float64():
    seen = asked()
    rng = np.random.default_rng(0)
    frames = [
        frame(look(rng.uniform(-1, 1, 3), rng.normal(size=3)), rng.uniform(0.5, 4, (SIZE, SIZE)))
        for _ in range(4)
    ]
    test = view(look((0.2, -0.1, 0.3), (0.5, 0.7, -0.2)), rng.uniform(0.5, 3, (SIZE, SIZE)))
    focal = SIZE / 2
    expected, doubtful = np.zeros((SIZE, SIZE), bool), np.zeros((SIZE, SIZE), bool)
    T = np.asarray(test.T_world_camera, np.float64)
    depth = np.asarray(test.depth, np.float64)
    for i in range(SIZE):
        for j in range(SIZE):
            ray = np.array([(j + 0.5 - SIZE / 2) / focal, (i + 0.5 - SIZE / 2) / focal, 1.0])
            point = T[:3, :3] @ (depth[i, j] * ray) + T[:3, 3]
            for other in frames:
                P = np.asarray(other.T_world_camera, np.float64)
                x, y, z = P[:3, :3].T @ (point - P[:3, 3])
                u, v = focal * x / z + SIZE / 2, focal * y / z + SIZE / 2
                # Rounding may decide within a hair of a border or of the tolerance.
                doubtful[i, j] |= min(abs(u - round(u)), abs(v - round(v))) < 1e-3
                if z <= 0 or not (0 <= u < SIZE and 0 <= v < SIZE):
                    continue
                around = np.asarray(other.depth)[
                    max(0, int(v) - 1) : int(v) + 2, max(0, int(u) - 1) : int(u) + 2
                ]
                doubtful[i, j] |= abs(z - around.max() - 0.05) < 1e-4
                expected[i, j] |= z <= around.max() + 0.05
    assert 0.1 < expected.mean() < 0.9
    assert doubtful.mean() < 0.1
    np.testing.assert_array_equal(seen(test, frames)[~doubtful], expected[~doubtful])
