"""Test views: poses, hash, storage and choice on a toy world; pictures on a real one."""

import json
import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.errors import InputError
from r3jax.evaluation import test_views
from r3jax.evaluation.test_views import (
    ViewSet,
    compute_view_set,
    load_view_set,
    read_view_set,
    render_view_set,
)
from r3jax.geometry.cameras import Camera, pose_along
from r3jax.simulators.free_space import GroundTruth
from r3jax.simulators.raycast.raycast import RaycastSimulator
from tests.simulators.rooms import box_room, facing_x

LOOKS = ("+x", "-x", "+y", "-y", "+z", "-z")
AXES = {"+x": (1, 0, 0), "-x": (-1, 0, 0), "+y": (0, 1, 0), "-y": (0, -1, 0)}
AXES |= {"+z": (0, 0, 1), "-z": (0, 0, -1)}


class Toy:
    """A lattice of 6 x 5 x 3 positions, all free; looking up there is nothing to see."""

    def __init__(self, scene_hash="ab" * 32, sky=0.0):
        self.scene, self.scene_hash, self._sky = "toy", scene_hash, sky
        self.asked = 0

    def free_positions(self, spacing, margin):
        self.asked += 1
        index = np.stack(np.meshgrid(*map(np.arange, (6, 5, 3)), indexing="ij"), axis=-1)
        return np.round(0.1234 + margin + index.reshape(-1, 3) * np.asarray(spacing), 4)

    def seen_share(self, poses):
        return np.where(poses[:, 2, 2] > 0.5, self._sky, 1.0)

    def frames(self, poses, camera):
        raise NotImplementedError


def stored(folder, **settings):
    return load_view_set(folder, Toy(), **settings)


def test_every_position_has_six_level_views_along_the_axes():
    views = compute_view_set(Toy(sky=1.0))
    assert len(views) == 6 * 90
    assert views.looks == LOOKS * 90
    for look, pose in zip(LOOKS, views.poses[:6], strict=True):
        np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=0.0)
        assert np.linalg.det(pose[:3, :3]) == 1.0
        np.testing.assert_array_equal(pose[:3, 2], AXES[look])
        assert pose[2, 0] == 0.0  # the image's x axis is level
        direction = np.array(AXES[look], np.float32)
        np.testing.assert_allclose(pose, pose_along(pose[:3, 3], direction), atol=1e-6)
    positions = np.repeat(Toy().free_positions((1.0, 1.0, 0.75), 0.3), 6, axis=0)
    np.testing.assert_array_equal(views.poses[:, :3, 3], positions)


def test_views_of_the_void_are_left_out():
    views = compute_view_set(Toy())
    assert len(views) == 5 * 90
    assert "+z" not in views.looks


def test_the_hash_knows_every_setting():
    compute = test_views.compute_view_set
    settings = [
        {},
        {"spacing": (1.0, 1.0, 0.5)},
        {"margin": 0.25},
        {"max_views": 60},
        {"max_views": 90 * 6},  # keeps every view, and is another setting
    ]
    hashes = [compute(Toy(), **chosen).hash for chosen in settings]
    hashes += [compute(Toy(scene_hash="cd" * 32)).hash, compute(Toy(sky=1.0)).hash]
    assert len(set(hashes)) == len(hashes)
    assert hashes == [compute(Toy(), **s).hash for s in settings] + hashes[-2:]


def test_the_hash_is_the_same_on_every_machine():
    """Golden: worked out once; a change of poses, rounding or form must be a decision."""
    assert compute_view_set(Toy(), max_views=12).hash == GOLDEN


GOLDEN = "c65d47a8609320c09a79fafe888c42e750d09174d43d658770b49ac7cce47060"


@given(st.integers(0, 89), st.integers(0, 2), st.sampled_from([-1e-4, 1e-4]))
def test_the_hash_knows_a_tenth_of_a_millimeter(view, axis, shift):
    views = compute_view_set(Toy(), max_views=120)
    fields = {name: getattr(views, name) for name in ViewSet.__dataclass_fields__}
    moved, noisy = views.positions.copy(), views.positions.copy()
    moved[view, axis] += shift
    noisy[view, axis] += 0.3 * shift  # below the resolution: another machine's rounding
    assert ViewSet(**fields | {"positions": moved}).hash != views.hash
    assert ViewSet(**fields | {"positions": noisy}).hash == views.hash


def test_a_choice_keeps_whole_positions_in_every_region():
    compute = test_views.compute_view_set
    everything = compute(Toy(sky=1.0))
    for max_views in (6, 65, 180, 539):
        views = compute(Toy(sky=1.0), max_views=max_views)
        assert len(views) == 6 * (max_views // 6)
        assert views.looks == LOOKS * (max_views // 6)
        assert (views.positions.reshape(-1, 6, 3) == views.positions[::6, None]).all()
        chosen = {*map(tuple, views.positions)}
        assert len(chosen) == max_views // 6
        assert chosen <= {*map(tuple, everything.positions)}
    # A third of the 90 positions: each half of the lattice holds its share, give or take a few.
    views = compute(Toy(sky=1.0), max_views=180)
    positions, middle = views.positions[::6], np.median(everything.positions, axis=0)
    for axis, expected in enumerate((15.0, 12.0, 10.0)):
        below = (positions[:, axis] < middle[axis]).sum()
        assert abs(below - expected) <= 3.5


def test_a_choice_is_the_same_every_time():
    first, second = (compute_view_set(Toy(), max_views=60) for _ in range(2))
    np.testing.assert_array_equal(first.poses, second.poses)


def test_a_set_is_computed_once_and_read_after_that(tmp_path):
    truth = Toy()
    first = load_view_set(tmp_path / "new", truth, max_views=30)
    second = load_view_set(tmp_path / "new", truth, max_views=30)
    assert truth.asked == 1
    np.testing.assert_array_equal(first.poses, second.poses)
    np.testing.assert_array_equal(first.poses, compute_view_set(Toy(), max_views=30).poses)
    assert (first.hash, first.looks, first.spacing) == (second.hash, second.looks, second.spacing)
    assert (second.scene, second.margin, second.max_views) == ("toy", 0.3, 30)
    assert len(list((tmp_path / "new").iterdir())) == 1  # nothing temporary is left


def test_other_settings_and_scenes_have_files_of_their_own(tmp_path):
    stored(tmp_path)
    stored(tmp_path, margin=0.25)
    stored(tmp_path, max_views=12)
    load_view_set(tmp_path, Toy(scene_hash="cd" * 32))
    assert len(list(tmp_path.iterdir())) == 4


def test_many_writers_at_once_do_no_harm(tmp_path):
    results = []
    ask = lambda: results.append(stored(tmp_path, max_views=60).hash)
    threads = [threading.Thread(target=ask) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert results == [compute_view_set(Toy(), max_views=60).hash] * 8
    assert len(list(tmp_path.iterdir())) == 1


def tamper(record):
    record["views"][3]["position"][0] += 1e-4


def swap(record):
    record["views"][0], record["views"][1] = record["views"][1], record["views"][0]


def law_a_changed_file_is_refused(folder):
    test_views.load_view_set(folder, Toy(), max_views=12)
    (path,) = folder.iterdir()
    good = path.read_text()
    changes = [tamper, swap, lambda r: r["views"].pop(), lambda r: r.update(margin=0.2)]
    changes += [lambda r: r.update(scene="other"), lambda r: r.update(scene_hash="cd" * 32)]
    for change in changes:
        record = json.loads(good)
        change(record)
        path.write_text(json.dumps(record))
        with pytest.raises(ValueError, match="delete") as caught:
            test_views.load_view_set(folder, Toy(), max_views=12)
        assert str(path) in str(caught.value)


def test_a_changed_file_is_refused(tmp_path):
    law_a_changed_file_is_refused(tmp_path)


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "{}", '{"format": 1}', '{"format": 1, "views": 3}']
)
def test_a_damaged_file_is_refused(tmp_path, text):
    stored(tmp_path)
    (path,) = tmp_path.iterdir()
    path.write_text(text)
    with pytest.raises(ValueError, match="delete"):
        stored(tmp_path)


def test_a_file_of_a_later_version_is_told_as_such(tmp_path):
    stored(tmp_path)
    (path,) = tmp_path.iterdir()
    path.write_text('{"format": 2, "unheard": "of"}')
    with pytest.raises(ValueError, match="version 2"):
        stored(tmp_path)


def test_a_file_of_other_settings_or_another_scene_is_refused(tmp_path):
    stored(tmp_path, max_views=12)
    (path,) = tmp_path.iterdir()
    stored(tmp_path, max_views=18)
    (other,) = set(tmp_path.iterdir()) - {path}
    other.write_bytes(path.read_bytes())
    with pytest.raises(InputError):
        stored(tmp_path, max_views=18)
    load_view_set(tmp_path / "b", Toy(scene_hash="cd" * 32), max_views=12)
    (foreign,) = (tmp_path / "b").iterdir()
    path.write_bytes(foreign.read_bytes())
    with pytest.raises(ValueError, match="scene"):
        stored(tmp_path, max_views=12)
    with pytest.raises(ValueError, match="scene"):
        render_view_set(Toy(), read_view_set(foreign), 16)


def test_settings_without_views_are_refused():
    with pytest.raises(ValueError, match="at least 6"):
        compute_view_set(Toy(), max_views=5)
    nowhere = Toy()
    nowhere.free_positions = lambda spacing, margin: np.zeros((0, 3))
    with pytest.raises(InputError):
        compute_view_set(nowhere)


def test_pictures_are_those_that_the_simulator_takes_there():
    start = facing_x(3.0, 2.0, 1.5)
    explorer = RaycastSimulator(box_room(), Camera.from_fov(64, 64, 60.0), start_pose=start)
    truth = GroundTruth(explorer)
    views = compute_view_set(truth, max_views=12)
    camera = Camera.from_fov(16, 16, 75.0)
    there = RaycastSimulator(box_room(), camera, start_pose=start, max_range=None)
    frames = list(render_view_set(truth, views, 16, 75.0))
    assert len(frames) == len(views) == 12
    for frame, pose in zip(frames, views.poses, strict=True):
        expected = there.render(pose)
        np.testing.assert_array_equal(frame.rgb, expected.rgb)
        np.testing.assert_array_equal(frame.depth, expected.depth)
        np.testing.assert_array_equal(frame.T_world_camera, expected.T_world_camera)
        np.testing.assert_array_equal(frame.camera.fx, camera.fx)
