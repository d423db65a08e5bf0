"""Poses that have diverged are left out; places that are far apart are not."""

import dataclasses
import json

import numpy as np
import pytest

from r3jax.captures.settings import SurveySettings
from r3jax.captures.source import source_of
from r3jax.captures.survey import strays, survey_of
from r3jax.formats.colmap.reader import read_colmap
from r3jax.formats.nerfstudio import read_transforms
from tests.apps.audit.room import round_poses, write_colmap, write_nerfstudio


def room_at(place: list[float], count: int, seed: int = 0) -> np.ndarray:
    """Cameras in a room, [n, 3]."""
    return np.asarray(place) + np.random.default_rng(seed).uniform(0.5, 4.0, (count, 3))


def walls(camera: np.ndarray) -> np.ndarray:
    """What a camera shows, wherever it is: a room of its own, [k, 3]."""
    offsets = np.random.default_rng(1).uniform(-2.0, 2.0, (200, 3))
    return camera + 2.0 * offsets / np.abs(offsets).max(axis=1, keepdims=True)


def found(cameras: np.ndarray) -> list[int]:
    every = np.arange(len(cameras))
    return every[strays(cameras, 2.0, lambda i: walls(cameras[i]))].tolist()


@pytest.mark.parametrize("far", [60.0, 3600.0, 4e4])
def test_a_camera_far_from_all_others_that_shows_nothing_in_common_has_diverged(far):
    cameras = room_at([0, 0, 0], 24)
    cameras[11] += [far, 0.6 * far, 1.0]
    assert found(cameras) == [11]
    cameras[3] -= [0.0, 3.0 * far, 0.0]  # each somewhere else, as after lost tracking
    assert found(cameras) == [3, 11]


def test_places_far_apart_are_all_kept():
    for first, second in ((12, 12), (20, 4), (100, 3)):
        cameras = np.concatenate([room_at([0, 0, 0], first), room_at([500, 0, 0], second, 1)])
        assert found(cameras) == []


def test_a_long_walk_a_lone_overview_and_few_cameras_are_kept():
    walk = np.stack([np.arange(200.0), np.zeros(200), np.zeros(200)], axis=1)
    assert found(walk) == []
    cameras = np.concatenate([room_at([0, 0, 0], 24), [[40.0, 0.0, 1.0]]])
    shows = lambda i: walls(cameras[0]) if i == 24 else walls(cameras[i])
    assert cameras[strays(cameras, 2.0, shows)].tolist() == []
    assert found(np.array([[0.0, 0, 0], [1e4, 0, 0]])) == []
    assert found(np.zeros((1, 3))) == []


def test_the_survey_is_that_of_the_others(tmp_path):
    poses = round_poses(9)
    folder = write_nerfstudio(tmp_path / "room", poses, depth=True)
    content = json.loads((folder / "transforms.json").read_text())
    others = survey_of(_without(source_of(read_transforms(folder), "room"), 4), SurveySettings())
    for axis, far in enumerate((60.0, 3000.0)):
        content["frames"][4]["transform_matrix"][axis][3] = far
    (folder / "transforms.json").write_text(json.dumps(content))
    survey = survey_of(source_of(read_transforms(folder), "room"), SurveySettings())
    assert survey.strays == (4,)
    assert survey.chosen.tolist() == [0, 1, 2, 3, 5, 6, 7, 8]
    np.testing.assert_array_equal(survey.bounds, others.bounds)
    assert survey.median_depth == others.median_depth


def _without(source, index: int):
    rest = [i for i in range(len(source)) if i != index]
    take = lambda values: tuple(values[i] for i in rest)
    return dataclasses.replace(
        source,
        poses=source.poses[rest],
        lenses=take(source.lenses),
        labels=take(source.labels),
        read=lambda i: source.read(rest[i]),
    )


def test_a_camera_of_a_structure_from_motion_that_diverged_is_left_out(tmp_path):
    poses = round_poses(9)
    source = source_of(read_colmap(write_colmap(tmp_path / "room", poses)), "room")
    far = source.poses.copy()
    far[4, :3, 3] += [3e4, 2e4, 4e3]
    survey = survey_of(source_of(_moved(tmp_path / "room", far), "room"), SurveySettings())
    assert survey.strays == (4,)


def _moved(folder, poses: np.ndarray):
    return dataclasses.replace(read_colmap(folder), poses=poses)
