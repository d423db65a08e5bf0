"""Scenes open by name, and unknown ones are answered with the known."""

import numpy as np
import pytest
import trimesh

from r3jax.geometry.cameras import Camera
from r3jax.simulators.base import NoisySimulator, Simulator
from r3jax.simulators.free_space import GroundTruth
from r3jax.simulators.scenes import registry

CAMERA = Camera.from_fov(64, 64, 60.0)


@pytest.fixture(scope="module")
def room_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("mesh") / "room.ply"
    box = trimesh.creation.box(extents=(6, 4, 3))
    box.invert()
    box.export(path)
    return path


def test_there_are_ten_embedded_scenes_each_with_a_line_about_it():
    names = registry.scene_names()
    assert len(names) == len(set(names)) == 10
    lines = [registry.describe(name) for name in names]
    assert all(lines)
    assert len(set(lines)) == 10


@pytest.mark.full
def test_an_embedded_scene_opens():
    name = registry.scene_names()[0]
    simulator = registry.open_scene(name, camera=CAMERA, seed=2)
    assert isinstance(simulator, Simulator)
    assert isinstance(simulator, NoisySimulator)
    frame = simulator.render(simulator.start_pose)
    assert np.asarray(frame.rgb).std() > 0.01
    assert np.isfinite(frame.depth).any()


def test_a_mesh_file_opens(room_file):
    simulator = registry.open_scene(f"mesh:{room_file}", camera=CAMERA, noise=0.0, max_range=None)
    assert isinstance(simulator, Simulator)
    depth = np.asarray(simulator.render(simulator.start_pose).depth)
    assert np.isfinite(depth).all()
    assert str(room_file) in registry.describe(f"mesh:{room_file}")


def test_noise_changes_the_depth_only(room_file):
    scene = f"mesh:{room_file}"
    exact = registry.open_scene(scene, camera=CAMERA, noise=0.0)
    noisy = registry.open_scene(scene, camera=CAMERA, noise=0.01)
    pose = exact.start_pose
    np.testing.assert_array_equal(noisy.start_pose, pose)
    a, b = exact.render(pose), noisy.render(pose)
    np.testing.assert_array_equal(a.rgb, b.rgb)
    ratio = np.asarray(b.depth / a.depth)
    ratio = ratio[np.isfinite(ratio)]
    assert 0.008 < ratio.std() < 0.012


def test_a_start_pose_and_a_range_are_passed_on(room_file):
    pose = np.eye(4)
    pose[:3, 3] = 0.2, 0.1, 0.0
    simulator = registry.open_scene(
        f"mesh:{room_file}", camera=CAMERA, start_pose=pose, max_range=1.0, noise=0.0
    )
    np.testing.assert_array_equal(simulator.start_pose, pose)
    assert np.isinf(simulator.render(pose).depth).all()


def test_the_hash_tells_scenes_apart_and_nothing_else(room_file, tmp_path):
    scene = f"mesh:{room_file}"
    first = registry.scene_hash(registry.open_scene(scene, camera=CAMERA))
    again = registry.scene_hash(registry.open_scene(scene, camera=CAMERA, noise=0.0, seed=5))
    other_file = tmp_path / "other.ply"
    trimesh.creation.box(extents=(6, 4, 2.9)).export(other_file)
    other = registry.scene_hash(registry.open_scene(f"mesh:{other_file}", camera=CAMERA))
    assert first == again
    assert first != other
    assert len(first) == 64


def test_a_simulator_from_elsewhere_has_no_hash():
    class Elsewhere:
        camera, bounds, start_pose = CAMERA, np.zeros((2, 3)), np.eye(4)

        def render(self, T_world_camera):
            raise NotImplementedError

    with pytest.raises(ValueError, match="Elsewhere"):
        registry.scene_hash(Elsewhere())


@pytest.mark.parametrize("ask", [registry.open_scene, registry.describe, registry.open_world])
def test_an_unknown_scene_is_answered_with_the_known_ones(ask):
    with pytest.raises(ValueError, match="'castle'") as caught:
        ask("castle")
    assert all(name in str(caught.value) for name in registry.scene_names())
    assert "mesh:<file>" in str(caught.value)


def test_a_mesh_without_a_file_name():
    with pytest.raises(ValueError, match="needs a file"):
        registry.open_scene("mesh:")


def test_the_up_axis_is_for_mesh_files():
    with pytest.raises(ValueError, match="mesh"):
        registry.open_scene(registry.scene_names()[0], up="y")


def test_a_scene_can_be_seen_without_its_back_faces(tmp_path):
    """As Habitat sees it: from outside, a room seen from within is open."""
    path = tmp_path / "box.ply"
    trimesh.creation.box(extents=(6, 4, 3)).export(path)  # its faces look outwards
    pose = np.eye(4)
    options = {"camera": CAMERA, "noise": 0.0, "max_range": None, "start_pose": pose}
    two_sided = registry.open_scene(f"mesh:{path}", **options)
    culled = registry.open_scene(f"mesh:{path}", cull_back_faces=True, **options)
    assert np.isfinite(two_sided.render(pose).depth).all()
    assert np.isinf(culled.render(pose).depth).all()
    assert registry.scene_hash(two_sided) != registry.scene_hash(culled)
    assert GroundTruth(culled).scene_hash == registry.scene_hash(culled)


def test_a_mesh_is_scaled(room_file):
    mesh = f"mesh:{room_file}"
    meters = registry.open_world(mesh)
    smaller = registry.open_world(mesh, scale=0.001)
    np.testing.assert_allclose(smaller.vertices, 0.001 * meters.vertices)
    assert registry.open_world(mesh, scale=1).content_hash == meters.content_hash
