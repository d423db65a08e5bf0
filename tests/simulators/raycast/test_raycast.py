"""Frames of rooms that can be worked out on paper."""

import itertools

import numpy as np
import pytest

from r3jax.geometry.cameras import Camera
from r3jax.simulators.base import Simulator
from r3jax.simulators.raycast.raycast import RaycastSimulator
from r3jax.simulators.world import Material
from tests.simulators.rooms import SMALL, box_quads, box_room, facing_x, world_of

BRIGHT, DARK = Material(color=(0.9, 0.8, 0.7)), Material(color=(0.1, 0.2, 0.3))


def wall(x):
    """A quad of 20 x 20 m across the x axis, its front towards the origin."""
    return (x, -10, -10), (0, 0, 20), (0, 20, 0)


def picture(simulator, pose):
    frame = simulator.render(pose)
    return np.asarray(frame.rgb), np.asarray(frame.depth)


@pytest.fixture(scope="module")
def room():
    return RaycastSimulator(box_room(), SMALL, max_range=None)


def test_it_is_a_simulator(room):
    assert isinstance(room, Simulator)
    np.testing.assert_allclose(room.bounds, [[0, 0, 0], [6, 4, 3]])


def test_depth_is_along_the_optical_axis_not_along_the_ray():
    _, depth = picture(RaycastSimulator(world_of([wall(4.0)]), SMALL), facing_x(1, 0, 0))
    np.testing.assert_allclose(depth, 3.0, rtol=1e-6)
    assert depth.dtype == np.float32


def test_unprojected_depth_lies_on_the_walls(room):
    pose = room.start_pose
    _, depth = picture(room, pose)
    rows, columns = np.mgrid[:64, :64] + 0.5
    focal = float(SMALL.fx)
    in_camera = np.stack([(columns - 32) / focal, (rows - 32) / focal, np.ones((64, 64))], axis=-1)
    points = (in_camera * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]
    np.testing.assert_allclose(room.clearance(points.reshape(-1, 3)), 0.0, atol=1e-4)


def test_beyond_the_range_depth_is_infinite_but_the_color_is_seen():
    world = world_of([wall(4.0)], [BRIGHT])
    rgb, depth = picture(RaycastSimulator(world, SMALL, max_range=3.0), facing_x(0, 0, 0))
    assert np.isinf(depth).all()
    np.testing.assert_allclose(rgb, np.broadcast_to([0.9, 0.8, 0.7], rgb.shape), atol=1e-6)


def test_where_the_world_ends_depth_is_infinite_and_the_color_black():
    rgb, depth = picture(RaycastSimulator(world_of([wall(4.0)]), SMALL), facing_x(5, 0, 0))
    assert np.isinf(depth).all()
    assert (rgb == 0.0).all()


def test_glass_has_color_but_no_depth():
    glass = Material(color=(0.5, 0.6, 0.7), is_hole=True)
    world = world_of([wall(2.0), wall(4.0)], [glass, BRIGHT], [0, 1])
    near, far = facing_x(0, 0, 0), facing_x(3, 0, 0)
    simulator = RaycastSimulator(world, SMALL)
    rgb, depth = picture(simulator, near)
    assert (depth == 0.0).all()
    np.testing.assert_allclose(rgb, np.broadcast_to([0.5, 0.6, 0.7], rgb.shape), atol=1e-6)
    np.testing.assert_allclose(picture(simulator, far)[1], 1.0, rtol=1e-6)
    # Out of range there is nothing that could fail.
    assert np.isinf(picture(RaycastSimulator(world, SMALL, max_range=1.0), near)[1]).all()


def test_the_same_pose_gives_the_same_frame(room):
    first, again = room.render(facing_x(2, 2, 1)), room.render(facing_x(2, 2, 1))
    np.testing.assert_array_equal(first.rgb, again.rgb)
    np.testing.assert_array_equal(first.depth, again.depth)


def test_image_axes_x_right_y_down():
    quads = [((4, 0, 0), (0, 0, 9), (0, 9, 0)), ((4, -9, 0), (0, 0, 9), (0, 9, 0))]
    world = world_of(quads, [BRIGHT, DARK], [0, 1])
    rgb, depth = picture(RaycastSimulator(world, SMALL), facing_x(0, 0, 0))
    assert np.isfinite(depth[:32]).all()  # z > 0 is up, in the upper half
    assert np.isinf(depth[32:]).all()
    assert (rgb[5, :30, 0] > 0.8).all()  # y > 0 is to the left of someone who looks along x
    assert (rgb[5, 34:, 0] < 0.2).all()


def test_a_mirror_shows_what_a_camera_behind_it_would_see():
    checks = np.zeros((64, 64, 3), np.uint8)
    checks[:32, :32], checks[32:, 32:], checks[:32, 32:] = 255, (200, 40, 10), (10, 90, 180)
    behind = ((-2, -6, -6), (0, 12, 0), (0, 0, 12))
    materials = [Material(color=(0.0, 0.0, 0.0), mirror=1.0), Material(texture=checks)]
    camera = Camera.from_fov(64, 64, 40.0)
    both = RaycastSimulator(world_of([wall(3.0), behind], materials, [0, 1]), camera)
    reflected, depth = picture(both, facing_x(0, 0, 0))
    np.testing.assert_allclose(depth, 3.0, rtol=1e-6)  # the mirror itself is what is measured
    # The mirror image of the camera: at x = 6, looking back along -x, its picture flipped.
    turned = facing_x(6, 0, 0)
    turned[:3, :3] = np.diag([-1.0, -1.0, 1.0]) @ turned[:3, :3]
    alone = RaycastSimulator(world_of([behind], materials[1:]), camera)
    direct = picture(alone, turned)[0][:, ::-1]
    assert direct.std() > 0.1
    np.testing.assert_allclose(reflected, direct, atol=0.02)


def test_without_lighting_a_mirror_shows_its_own_color():
    world = world_of([wall(3.0)], [Material(color=(0.2, 0.3, 0.4), mirror=1.0)])
    rgb, _ = picture(RaycastSimulator(world, SMALL, lighting=False), facing_x(0, 0, 0))
    np.testing.assert_allclose(rgb, np.broadcast_to([0.2, 0.3, 0.4], rgb.shape), atol=1e-6)


def test_culling_looks_into_a_room_from_outside():
    world = box_room()
    _, closed = picture(RaycastSimulator(world, SMALL, max_range=None), facing_x(-3, 2, 1.5))
    _, opened = picture(
        RaycastSimulator(world, SMALL, max_range=None, cull_back_faces=True), facing_x(-3, 2, 1.5)
    )
    np.testing.assert_allclose(closed[32, 32], 3.0, rtol=1e-5)
    np.testing.assert_allclose(opened[32, 32], 9.0, rtol=1e-5)


def slanted_bars():
    """Bright bars before a dark wall, at an angle to the pixels, some thinner than two pixels."""
    bars = [((3, y, -9), (0, 1.5, 18), (0, 0.06 + 0.01 * k, 0)) for k, y in enumerate(range(-6, 6))]
    return world_of([wall(5.0), *bars], [DARK, BRIGHT], [0] + [1] * len(bars))


@pytest.fixture(scope="module")
def creeping():
    """A camera that creeps sideways by a third of a pixel, and what it would see ideally."""
    scale, poses = 8, [facing_x(0, 0.018 * k, 0.02) for k in range(4)]
    fine = Camera.from_fov(64 * scale, 64 * scale, 60.0)
    many = RaycastSimulator(slanted_bars(), fine, supersample=0)
    boxes = [picture(many, pose)[0].reshape(64, scale, 64, scale, 3) for pose in poses]
    return poses, [box.mean(axis=(1, 3)) for box in boxes]


def errors(creeping, supersample):
    simulator = RaycastSimulator(slanted_bars(), SMALL, supersample=supersample)
    return [picture(simulator, pose)[0] - ideal for pose, ideal in zip(*creeping, strict=True)]


def test_edges_are_smooth(creeping):
    psnr = lambda error: -10.0 * np.log10(np.mean(error**2))
    smooth, jagged = errors(creeping, 4)[0], errors(creeping, 0)[0]
    assert psnr(smooth) > 32.0
    assert psnr(smooth) > psnr(jagged) + 7.0


def test_pictures_do_not_flicker_when_the_camera_creeps(creeping):
    def flicker(supersample):
        error = errors(creeping, supersample)
        return np.mean([np.abs(b - a).mean() for a, b in itertools.pairwise(error)])

    assert flicker(4) < 0.4 * flicker(0)


def test_depth_is_never_mixed_across_an_edge():
    world = slanted_bars()
    _, depth = picture(RaycastSimulator(world, SMALL), facing_x(0, 0.013, 0.02))
    np.testing.assert_allclose(np.minimum(np.abs(depth - 3.0), np.abs(depth - 5.0)), 0, atol=1e-5)


def test_a_segment_is_clear_unless_a_surface_lies_on_it(room):
    inside, other, outside = np.array([[1.0, 1, 1], [5, 3, 2], [7, 3, 2]])
    assert room.segment_is_clear(inside, other)
    assert not room.segment_is_clear(inside, outside)
    assert not room.segment_is_clear(outside, inside)
    assert room.segment_is_clear(inside, inside)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda T: T * np.nan, "not finite"),
        (lambda T: 2.0 * T, "not rigid"),
        (lambda T: np.diag([1.0, 1, -1, 1]) @ T, "mirrors"),
        (lambda T: T[:3], "4x4"),
    ],
)
def test_a_bad_pose_is_refused(room, spoil, words):
    with pytest.raises(ValueError, match=words):
        room.render(spoil(facing_x(2, 2, 1)))


@pytest.mark.parametrize("settings", [{"max_range": 0.0}, {"supersample": 9}])
def test_settings_out_of_range_are_named(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        RaycastSimulator(world_of(box_quads((0, 0, 0), (1, 1, 1), inward=True)), SMALL, **settings)
