"""Replica's scenes by name, in the ray caster and in Habitat, from a folder laid out like it."""

import json
import sys

import numpy as np
import pytest
import trimesh

from r3jax.geometry.cameras import Camera
from r3jax.simulators import habitat
from r3jax.simulators.base import NoisySimulator
from r3jax.simulators.free_space import GroundTruth
from r3jax.simulators.meshes import load_world
from r3jax.simulators.raycast.raycast import RaycastSimulator
from r3jax.simulators.scenes import names, registry
from tests.simulators.habitat.fake_habitat import FakeHabitat

CAMERA = Camera.from_fov(32, 24, 60.0)


@pytest.fixture
def root(tmp_path, monkeypatch):
    """Two scenes: office_0 whole, room_1 without a mesh."""
    folder = tmp_path / "office_0"
    (folder / "habitat").mkdir(parents=True)
    (tmp_path / "room_1").mkdir()
    box = trimesh.creation.box(extents=(6, 4, 3))
    box.invert()
    box.visual.vertex_colors = 40 * np.arange(8)[:, None] * [1, 0, 0] % 256 + [0, 90, 30]
    box.export(folder / "mesh.ply")
    stage = {"render_asset": "../mesh.ply", "up": [0, 0, 1], "front": [0, 1, 0]}
    (folder / "habitat" / "replicaSDK_stage.stage_config.json").write_text(json.dumps(stage))
    monkeypatch.setenv(names.REPLICA_ROOT, str(tmp_path))
    return tmp_path


@pytest.fixture
def fake(root, monkeypatch):
    """A Habitat-Sim that shows office_0 as the real one does: not turned, though its stage config
    asks for it, and dark."""
    world = load_world(root / "office_0" / "mesh.ply")
    caster = RaycastSimulator(world, CAMERA, max_range=None, supersample=0)

    def answer(position, rotation):
        pose = np.eye(4)
        pose[:3, :3] = rotation @ np.diag([1.0, -1.0, -1.0])
        pose[:3, 3] = position
        frame = caster.render(pose)
        return np.uint8(np.round(np.asarray(frame.rgb) * 100)), np.asarray(frame.depth)

    fake = FakeHabitat(answer)
    for name, module in fake.modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(habitat, "default_gpu_device", lambda: -1)
    return fake


def test_there_are_nine_scenes():
    assert names.replica_names() == [
        "hotel0",
        *(f"office{k}" for k in range(5)),
        *(f"room{k}" for k in range(3)),
    ]


def test_a_scene_is_its_mesh(root):
    scene = registry.open_scene("replica:office0", camera=CAMERA, noise=0.0, seed=1)
    mesh = registry.open_scene(f"mesh:{root}/office_0/mesh.ply", camera=CAMERA, noise=0.0, seed=1)
    np.testing.assert_allclose(scene.bounds, [[-3, -2, -1.5], [3, 2, 1.5]])
    np.testing.assert_array_equal(scene.start_pose, mesh.start_pose)
    frame = scene.render(scene.start_pose)
    np.testing.assert_array_equal(frame.rgb, mesh.render(scene.start_pose).rgb)
    assert np.asarray(frame.rgb)[..., 0].std() > 0.01
    assert registry.scene_hash(scene) == registry.scene_hash(mesh)
    assert GroundTruth(scene).scene == "office0"
    assert "office0" in registry.describe("replica:office0")


def test_habitat_shows_the_same_scene(fake, root):
    theirs = registry.open_scene("habitat:office0", camera=CAMERA, seed=1)
    ours = registry.open_scene("replica:office0", camera=CAMERA, seed=1)
    assert isinstance(theirs, NoisySimulator)
    pose = ours.start_pose
    np.testing.assert_array_equal(theirs.start_pose, pose)
    a, b = theirs.render(pose), ours.render(pose)
    np.testing.assert_allclose(a.depth, b.depth, rtol=1e-4)
    np.testing.assert_allclose(a.rgb, b.rgb, atol=0.01)
    dark = habitat.HabitatSimulator(names.stage_file("office0"), CAMERA, mesh_colors=False, seed=1)
    np.testing.assert_allclose(dark.render(pose).rgb, np.asarray(b.rgb) * 100 / 255, atol=0.01)
    assert dark.content_hash != registry.scene_hash(theirs)
    assert fake.started[0][0].scene_id.startswith(str(root / "office_0" / "habitat"))
    assert registry.scene_hash(theirs) != registry.scene_hash(ours)
    assert "office0" in registry.describe("habitat:office0")


def test_habitat_takes_files_too(fake, root):
    stage = root / "office_0" / "habitat" / "replicaSDK_stage.stage_config.json"
    simulator = registry.open_scene(f"habitat:{stage}", camera=CAMERA, noise=0.0)
    assert fake.started[0][0].scene_id == str(stage)
    assert np.isfinite(simulator.render(simulator.start_pose).depth).any()
    np.testing.assert_allclose(registry.open_world(f"habitat:{stage}").bounds, simulator.bounds)


def test_the_stage_config_of_the_download_will_do(root):
    folder = root / "office_0" / "habitat"
    (folder / "replicaSDK_stage.stage_config.json").rename(
        folder / "replica_stage.stage_config.json"
    )
    assert names.stage_file("office0") == folder / "replica_stage.stage_config.json"


def test_without_habitat_it_says_how_to_get_it(root, monkeypatch):
    monkeypatch.setitem(sys.modules, "habitat_sim", None)
    with pytest.raises(ImportError, match="conda install habitat-sim"):
        registry.open_scene("habitat:office0", camera=CAMERA)


@pytest.mark.parametrize("value", [None, ""])
def test_without_the_variable_it_says_how_to_get_the_data(monkeypatch, value):
    monkeypatch.delenv(names.REPLICA_ROOT, raising=False)
    if value is not None:
        monkeypatch.setenv(names.REPLICA_ROOT, value)
    for scene in ("replica:room2", "habitat:room2"):
        with pytest.raises(ValueError, match=r"R3JAX_REPLICA_ROOT.*Replica-Dataset.*download\.sh"):
            registry.open_scene(scene, camera=CAMERA)


@pytest.mark.parametrize(
    ("scene", "fact"),
    [
        ("replica:room1", r"room_1/mesh\.ply.*download\.sh"),
        ("habitat:room1", r"replicaSDK_stage\.stage_config\.json"),
        ("replica:office9", "'office9'.*hotel0.*room2"),
        ("habitat:office9", "'office9'.*hotel0.*room2"),
        ("replica:", "replica:office0"),
        ("habitat:", "habitat:house.glb"),
    ],
)
def test_scenes_that_are_not_there_are_named(root, scene, fact):
    with pytest.raises(ValueError, match=fact):
        registry.open_scene(scene, camera=CAMERA)


def test_replica_is_upright(root):
    with pytest.raises(ValueError, match="replica:office0"):
        registry.open_scene("replica:office0", up="y")


def test_the_list_of_scenes_names_them_without_the_data():
    kinds = [spec.partition(":")[0] for spec in registry.outside_scenes()]
    assert kinds == ["mesh", "replica", "habitat"]
