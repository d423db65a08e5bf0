"""Frames against pictures taken with Habitat-Sim and an OpenGL depth image.

Habitat: flat shading, mip maps, no anti-aliasing; 0 in its depth is "no surface".
"""

import numpy as np
import pytest

from r3jax.geometry.cameras import Camera
from r3jax.simulators.meshes import load_world
from r3jax.simulators.raycast.raycast import RaycastSimulator
from tests.simulators.habitat.habitat_golden import load_house, load_simple_room


def compare(simulator, poses, golden):
    """Share of pixels with depth within 1 cm, and mean absolute color difference [0..255]."""
    close, difference = [], []
    for pose, rgb, depth in zip(poses, golden["rgb"], golden["depth"], strict=True):
        frame = simulator.render(pose)
        ours = np.where(np.isinf(frame.depth), 0.0, frame.depth)
        close.append(np.mean(np.abs(ours - depth) < 0.01))
        difference.append(np.abs(np.asarray(frame.rgb) * 255.0 - rgb).mean())
    return np.array(close), np.array(difference)


@pytest.fixture(scope="module")
def house(shared):
    golden = load_house(shared)
    return golden, load_world(golden.mesh)


@pytest.mark.full
def test_the_house_looks_as_in_habitat(house):
    golden, world = house
    simulator = RaycastSimulator(world, golden.camera, max_range=None, lighting=False)
    close, difference = compare(simulator, golden.poses, golden.frames)
    assert close.mean() >= 0.9999
    assert close.min() >= 0.999
    assert difference.mean() <= 2.0  # 1.7 of 255; edges are smooth here and jagged there
    assert difference.max() <= 4.0


@pytest.mark.full
def test_without_smooth_edges_the_house_is_nearer_still(house):
    golden, world = house
    simulator = RaycastSimulator(
        world, golden.camera, max_range=None, lighting=False, supersample=0
    )
    few = {name: golden.frames[name][::4] for name in ("rgb", "depth")}
    _, difference = compare(simulator, golden.poses[::4], few)
    assert difference.mean() <= 1.2


def test_the_house_is_turned_upright(house):
    _, world = house
    np.testing.assert_allclose(world.bounds, [[-9.5, -5.7, 0.0], [9.5, 5.7, 3.0]], atol=0.01)


@pytest.mark.full
def test_the_start_in_the_house_is_in_a_room(house):
    _, world = house
    simulator = RaycastSimulator(world, Camera.from_fov(64, 64, 60.0))
    start = simulator.start_pose
    assert simulator.clearance(start[None, :3, 3])[0] >= 1.0
    depth = np.asarray(simulator.render(start).depth)
    assert np.isfinite(depth).mean() > 0.3
    assert (depth > 0.5).all()


def test_a_flat_colored_room_with_holes_is_the_same(shared):
    golden = load_simple_room(shared)
    simulator = RaycastSimulator(
        load_world(golden.mesh, golden.up),
        golden.camera,
        max_range=None,
        lighting=False,
        supersample=0,
    )
    close, difference = compare(simulator, golden.poses, golden.frames)
    assert close.min() >= 0.9999
    assert difference.max() <= 0.05


def test_depth_with_culled_back_faces_is_as_in_opengl(shared):
    folder = shared("golden", "van_gogh_depth")
    golden = np.load(folder / "golden_depth.npz")
    camera = Camera(320, 240, *(float(golden[name]) for name in ("fx", "fy", "cx", "cy")))
    simulator = RaycastSimulator(
        load_world(folder / "van-gogh-room.mesh.ply"),
        camera,
        max_range=None,
        cull_back_faces=True,
        supersample=0,
    )
    opencv_from_opengl = np.diag([1.0, -1.0, -1.0, 1.0])
    frame = simulator.render(np.linalg.inv(golden["view"]) @ opencv_from_opengl)
    ours = np.where(np.isinf(frame.depth), 0.0, frame.depth)
    assert np.mean(np.abs(ours - golden["depth"]) < 0.01) >= 0.999
