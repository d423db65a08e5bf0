"""What Habitat is asked, and what becomes of its answers.

A fake answers with frames that the real one gave. Tests of the real one need it installed.
"""

import os
import signal
import subprocess
import sys
from types import SimpleNamespace

import equinox as eqx
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from r3jax.errors import InputError
from r3jax.geometry.cameras import Camera
from r3jax.simulators import habitat
from r3jax.simulators.base import NoisySimulator, Simulator
from r3jax.simulators.free_space import GroundTruth
from r3jax.simulators.habitat import BARE_GLB
from r3jax.simulators.meshes import load_world, world_from_file
from r3jax.simulators.raycast.embree import library
from r3jax.simulators.raycast.raycast import RaycastSimulator
from tests.simulators.habitat.fake_habitat import NOISE, FakeHabitat
from tests.simulators.habitat.habitat_golden import Golden, load_house, load_simple_room
from tests.tiers import quick_and_full

OPENGL = np.diag([1.0, -1.0, -1.0])


def recorded(golden: Golden):
    """Answers with the frame of a recorded sensor state, and with nothing elsewhere."""
    frames = golden.frames
    axes = Rotation.from_quat(np.roll(frames["sensor_rotation_wxyz"], -1, axis=1)).as_matrix()

    def answer(position, rotation):
        is_near = np.abs(frames["sensor_position"] - position).max(axis=1) < 1e-5
        is_near &= np.abs(axes - rotation).max(axis=(1, 2)) < 1e-5
        (index,) = np.flatnonzero(is_near)
        return frames["rgb"][index], frames["depth"][index]

    return answer


def ray_cast(golden: Golden, camera: Camera, turn: np.ndarray):
    """Answers with the mesh at any state, its world turned by `turn` [3, 3]."""
    world = load_world(golden.mesh, golden.up)
    options = {"max_range": None, "supersample": 0, "lighting": False, "cull_back_faces": True}
    caster = RaycastSimulator(world, camera, **options)

    def answer(position, rotation):
        pose = np.eye(4)
        pose[:3, :3] = turn.T @ golden.habitat_from_world.T @ rotation @ OPENGL
        pose[:3, 3] = turn.T @ golden.habitat_from_world.T @ position
        frame = caster.render(pose)
        depth = np.where(np.isinf(frame.depth), 0.0, frame.depth)
        return np.uint8(np.round(np.asarray(frame.rgb) * 255)), depth

    return answer


def installed(fake: FakeHabitat, patch) -> FakeHabitat:
    for name, module in fake.modules.items():
        patch.setitem(sys.modules, name, module)
    patch.setattr(habitat.ctypes, "CDLL", no_library)
    return fake


def no_library(name):
    raise OSError(f"there is no {name}")


@pytest.fixture(
    scope="module", params=quick_and_full([load_house, load_simple_room], [load_simple_room])
)
def golden(request, shared):
    return request.param(shared)


@pytest.fixture(scope="module")
def room(shared):
    return load_simple_room(shared)


def test_it_gives_the_recorded_frames(room, monkeypatch):
    """At our poses: copies, colors in [0, 1], holes as 0."""
    installed(FakeHabitat(recorded(room)), monkeypatch)
    simulator = habitat.HabitatSimulator(room.mesh, room.camera, up=room.up, max_range=4.0)
    for frame, rgb, depth in zip(
        [simulator.render(pose) for pose in room.poses],
        room.frames["rgb"],
        room.frames["depth"],
        strict=True,
    ):
        assert (depth == 0.0).any()
        np.testing.assert_array_equal(frame.depth, np.where(depth <= 4.0, depth, np.inf))
        np.testing.assert_array_equal(np.round(np.asarray(frame.rgb) * 255), rgb)


def test_it_requests_two_sensors_in_the_agents_origin(room, monkeypatch):
    """[H, W], the horizontal angle, no CUDA device."""
    fake = installed(FakeHabitat(recorded(room)), monkeypatch)
    habitat.HabitatSimulator(room.mesh, Camera.from_fov(64, 48, 90.0), up=room.up)
    ((settings, sensors),) = fake.started
    assert settings.scene_id == str(room.mesh)
    assert settings.gpu_device_id == -1
    assert [sensor.sensor_type for sensor in sensors] == ["color", "depth"]
    for sensor in sensors:
        assert sensor.resolution == [48, 64]
        assert sensor.hfov.value == pytest.approx(90.0, abs=1e-4)
        assert sensor.position == [0.0, 0.0, 0.0]


def test_the_frames_are_those_of_the_ray_caster(golden, monkeypatch):
    installed(FakeHabitat(recorded(golden)), monkeypatch)
    options = {"max_range": 3.0, "start_pose": golden.poses[0]}
    theirs = habitat.HabitatSimulator(golden.mesh, golden.camera, up=golden.up, **options)
    world = load_world(golden.mesh, golden.up)
    ours = RaycastSimulator(world, golden.camera, lighting=False, supersample=0, **options)
    assert isinstance(theirs, Simulator)
    np.testing.assert_array_equal(theirs.bounds, ours.bounds)
    assert eqx.tree_equal(theirs.camera, golden.camera)
    assert theirs.content_hash not in (world.content_hash, "")
    for i in range(0, len(golden.poses), 5):
        a, b = theirs.render(golden.poses[i]), ours.render(golden.poses[i])
        is_hole = golden.frames["depth"][i] == 0.0
        expected = np.where(is_hole, 0.0, b.depth)
        assert np.isclose(a.depth, expected, rtol=0.0, atol=0.01).mean() > 0.999
        assert np.abs(np.asarray(a.rgb) - np.asarray(b.rgb)).mean() < 3.0 / 255.0
        np.testing.assert_array_equal(a.T_world_camera, b.T_world_camera)


def test_noise_leaves_holes_and_what_is_out_of_range(room, monkeypatch):
    installed(FakeHabitat(recorded(room)), monkeypatch)
    pose = room.poses[0]
    options = {"up": room.up, "max_range": 4.0, "start_pose": pose}
    exact = habitat.HabitatSimulator(room.mesh, room.camera, **options)
    before = np.asarray(exact.render(pose).depth)
    after = np.asarray(NoisySimulator(exact, 0.01).render(pose).depth)
    is_measured = (before > 0.0) & np.isfinite(before)
    assert is_measured.any()
    assert not is_measured.all()
    np.testing.assert_array_equal(after[~is_measured], before[~is_measured])
    assert 0.008 < (after[is_measured] / before[is_measured]).std() < 0.012


CAMERA = Camera.from_fov(32, 24, 60.0)
library()  # loaded before tests take `CDLL` away


@pytest.fixture(autouse=True)
def _nothing_shared():
    """A simulator that the traceback of another test holds would answer in place of the fake."""
    habitat._SHARED.clear()


def box_room(path, *, is_inward: bool):
    """A GLB of 6 x 5 x 3 m whose faces have their front inside or outside."""
    box = trimesh.creation.box((6, 3, 5))
    if is_inward:
        box.invert()
    box.export(path)
    return SimpleNamespace(mesh=path, up="y", habitat_from_world=BARE_GLB @ world_from_file(path).T)


def test_it_starts_where_the_ray_caster_does(tmp_path, monkeypatch):
    room = box_room(tmp_path / "a.glb", is_inward=True)
    installed(FakeHabitat(ray_cast(room, CAMERA, np.eye(3))), monkeypatch)
    theirs = habitat.HabitatSimulator(room.mesh, CAMERA, seed=3)
    ours = RaycastSimulator(load_world(room.mesh), CAMERA, seed=3)
    np.testing.assert_array_equal(theirs.start_pose, ours.start_pose)
    pose = ours.start_pose.copy()
    pose[:3, 3] += 0.1
    given = habitat.HabitatSimulator(room.mesh, CAMERA, start_pose=pose)
    np.testing.assert_array_equal(given.start_pose, pose)


def test_test_views_are_habitats_and_free_space_is_the_meshs(tmp_path, monkeypatch):
    """Of the camera of the test views, without noise or limit of range."""
    room = box_room(tmp_path / "a.glb", is_inward=True)
    fake = FakeHabitat(lambda *state: ray_cast(room, requested(fake), np.eye(3))(*state))
    installed(fake, monkeypatch)
    theirs = habitat.HabitatSimulator(room.mesh, CAMERA, max_range=1.0, seed=3)
    judged = GroundTruth(NoisySimulator(theirs, 0.01, 0))
    ours = RaycastSimulator(load_world(room.mesh), CAMERA, seed=3)
    expected = GroundTruth(ours)
    places = judged.free_positions((0.5, 0.5, 0.5), 0.3)
    np.testing.assert_array_equal(places, expected.free_positions((0.5, 0.5, 0.5), 0.3))
    assert judged.scene_hash == theirs.content_hash != expected.scene_hash
    wide = Camera.from_fov(40, 30, 80.0)
    for frame in judged.frames(ours.start_pose[None], wide):
        caster = ours.with_camera(wide, max_range=None, cull_back_faces=True)
        np.testing.assert_array_equal(frame.depth, caster.render(ours.start_pose).depth)
        assert np.asarray(frame.depth).max() > 1.0
    assert np.isinf(theirs.render(ours.start_pose).depth).any()


def requested(fake: FakeHabitat) -> Camera:
    """The camera of the newest simulator."""
    _, (sensor, _) = fake.started[-1]
    height, width = sensor.resolution
    return Camera.from_fov(width, height, sensor.hfov.value)


def test_another_world_is_noticed(tmp_path, monkeypatch):
    room = box_room(tmp_path / "a.glb", is_inward=True)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    installed(FakeHabitat(ray_cast(room, CAMERA, turn)), monkeypatch)
    simulator = habitat.HabitatSimulator(room.mesh, CAMERA)
    with pytest.raises(InputError):
        _ = simulator.start_pose


@pytest.mark.parametrize("is_inward", [True, False])
def test_faces_that_look_outward_are_refused(is_inward, tmp_path, monkeypatch):
    room = box_room(tmp_path / "a.glb", is_inward=is_inward)
    installed(FakeHabitat(ray_cast(room, CAMERA, np.eye(3))), monkeypatch)
    simulator = habitat.HabitatSimulator(room.mesh, CAMERA)
    if is_inward:
        assert simulator.start_pose.shape == (4, 4)
        return
    with pytest.raises(ValueError, match=r"mesh:<file>"):
        _ = simulator.start_pose


def test_the_same_scene_shares_one_simulator(room, monkeypatch):
    fake = installed(FakeHabitat(recorded(room)), monkeypatch)
    cameras = [habitat.HabitatSimulator(room.mesh, room.camera, up=room.up) for _ in range(2)]
    for simulator in [*cameras, *cameras]:
        simulator.render(room.poses[0])
    assert len(fake.started) == 1
    first = cameras.pop(0)
    first.close()
    del first, simulator
    cameras[0].render(room.poses[0])
    assert len(fake.started) == 2
    assert len(fake.alive) == 1


def test_another_camera_takes_the_place_of_the_first(room, monkeypatch):
    fake = installed(FakeHabitat(ray_cast(room, CAMERA, np.eye(3))), monkeypatch)
    wide = Camera.from_fov(32, 24, 90.0)
    first, second = (habitat.HabitatSimulator(room.mesh, c, up=room.up) for c in (CAMERA, wide))
    for simulator in (first, second, first):
        simulator.render(room.poses[0])
        assert len(fake.alive) == 1
    assert len(fake.started) == 5
    del first, simulator
    second.render(room.poses[0])
    assert len(fake.alive) == 1


def test_the_stand_in_ends_as_the_real_one_does_with_two_simulators(room, monkeypatch):
    fake = installed(FakeHabitat(recorded(room)), monkeypatch)
    simulators = []
    for fov in (60.0, 90.0):
        monkeypatch.setattr(habitat._Habitat, "_current", None)  # as if it knew of no other
        one = habitat._shared_habitat(
            (*fake.modules.values(),), room.mesh, (room.camera.height, room.camera.width), fov, -1
        )
        simulators.append(one)
    simulators[0].close()
    with pytest.raises(SystemExit, match="no current context"):
        simulators[1].observe(np.zeros(3), np.eye(3))


def test_what_habitat_cannot_show_is_refused(room, monkeypatch):
    installed(FakeHabitat(recorded(room)), monkeypatch)
    wall = np.eye(4)
    wall[:3, 3] = load_world(room.mesh, "z").vertices[0]
    with pytest.raises(ValueError, match="start"):
        habitat.HabitatSimulator(room.mesh, CAMERA, up=room.up, start_pose=wall)
    with pytest.raises(ValueError, match="not rigid"):
        habitat.HabitatSimulator(room.mesh, CAMERA, up=room.up).render(2.0 * np.eye(4))
    with pytest.raises(ValueError, match="square pixels"):
        habitat.HabitatSimulator(room.mesh, Camera(32, 24, 30.0, 31.0, 16.0, 12.0))


def test_without_habitat_it_says_how_to_get_it(room, monkeypatch):
    monkeypatch.setitem(sys.modules, "habitat_sim", None)
    with pytest.raises(ImportError, match=r"conda install habitat-sim.*mesh:<file>"):
        habitat.HabitatSimulator(room.mesh, CAMERA, up=room.up)


def test_noise_is_kept_from_the_terminal_and_trouble_is_not(room, monkeypatch, capfd):
    fake = installed(FakeHabitat(recorded(room)), monkeypatch)
    habitat.HabitatSimulator(room.mesh, CAMERA, up=room.up).close()
    assert capfd.readouterr().err == ""
    fake.writes = b"unable to create a context\n" + NOISE + b"no texture"
    habitat.HabitatSimulator(room.mesh, CAMERA, up=room.up)
    os.write(2, b"later")
    assert capfd.readouterr().err == "unable to create a context\nno texture\nlater"


def test_trouble_is_told_when_habitat_ends_the_process():
    program = "import os; from r3jax.simulators import habitat\n"
    program += "with habitat._without_noise(): os.write(2, b'no device'); os.abort()"
    done = subprocess.run([sys.executable, "-c", program], stderr=subprocess.PIPE)
    assert done.returncode == -signal.SIGABRT
    assert done.stderr == b"no device\n"


def test_lines_are_warned_of(tmp_path, monkeypatch):
    scene = trimesh.Scene([trimesh.creation.box((4, 4, 3))])
    scene.add_geometry(trimesh.load_path(np.array([[0.0, 0, 0], [1, 1, 1]])))
    scene.export(tmp_path / "a.glb")
    installed(FakeHabitat(lambda position, rotation: (None, None)), monkeypatch)
    with pytest.warns(UserWarning, match="1 meshes"):
        habitat.HabitatSimulator(tmp_path / "a.glb", CAMERA)


def cuda_with(devices: int, *, is_broken: bool = False):
    """A CUDA driver with that many devices."""

    def count(pointer) -> int:
        pointer._obj.value = devices
        return 0

    return SimpleNamespace(cuInit=lambda flags: int(is_broken), cuDeviceGetCount=count)


@pytest.mark.parametrize(
    ("driver", "has_egl", "expected"),
    [
        (None, True, -1),
        (cuda_with(0), True, -1),
        (cuda_with(2, is_broken=True), True, -1),
        (cuda_with(2), False, -1),
        (cuda_with(1), True, 0),
        (cuda_with(2), True, 0),
    ],
)
def test_a_cuda_device_is_used_only_where_there_is_one(driver, has_egl, expected, monkeypatch):
    there = {"libcuda.so.1": driver, "libEGL_nvidia.so.0": SimpleNamespace() if has_egl else None}
    monkeypatch.setattr(habitat.ctypes, "CDLL", lambda name: there[name] or no_library(name))
    assert habitat.default_gpu_device() == expected


def test_a_device_that_is_asked_for_is_used(room, monkeypatch):
    fake = installed(FakeHabitat(recorded(room), has_cuda=True), monkeypatch)
    habitat.HabitatSimulator(room.mesh, CAMERA, up=room.up, gpu_device_id=1)
    assert fake.started[0][0].gpu_device_id == 1


@pytest.mark.filterwarnings("ignore")  # its own, on import
def test_the_real_habitat_gives_the_recorded_frames(golden):
    pytest.importorskip(
        "habitat_sim",
        reason="Habitat-Sim is not installed (see docs/howto/habitat.md)",
    )
    simulator = habitat.HabitatSimulator(
        golden.mesh, golden.camera, up=golden.up, max_range=None, start_pose=golden.poses[0]
    )
    assert simulator.start_pose.shape == (4, 4)
    for i, pose in enumerate(golden.poses):
        frame = simulator.render(pose)
        depth, rgb = golden.frames["depth"][i], golden.frames["rgb"][i]
        assert (np.abs(np.asarray(frame.depth) - depth) < 0.01).mean() > 0.999
        assert np.abs(np.asarray(frame.rgb) * 255.0 - rgb).mean() < 1.0
