"""Poses of a wrong convention are noticed, and right ones never, on recorded and made frames."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import r3jax
from r3jax.formats.recordings import read_recording
from r3jax.frame import CONVENTIONS
from r3jax.planning.pose_check import Reference, check_poses, contradicted, reference_of
from tests.rooms_of_boxes import ROOM, frame_in_room, pose_at

CAMERA = r3jax.Camera.from_fov(64, 48, 70.0)
WRONG = [name for name in CONVENTIONS if name != "opencv"]


def misread(T: np.ndarray, convention: str) -> np.ndarray:
    """What a program of that convention would hand over as the pose."""
    is_inverted, axes = CONVENTIONS[convention]
    return np.linalg.inv(T) if is_inverted else T @ np.linalg.inv(axes)


def observed(frames: list[r3jax.Frame], poses) -> tuple[list[str], Reference | None]:
    """Warnings about frames at other poses, and what is kept in the end."""
    reference = None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for frame, pose in zip(frames, poses, strict=True):
            reference = check_poses(reference, replace(frame, T_world_camera=np.float32(pose)))
    return [str(one.message) for one in caught], reference


@pytest.fixture(scope="module")
def lounge(shared):
    recording = read_recording(shared("recordings", "hololens_lounge"), "z")
    frames = [recording.frame(i) for i in range(len(recording))]
    return frames, [np.asarray(frame.T_world_camera, np.float64) for frame in frames]


@pytest.mark.full
def test_a_recording_never_contradicts_itself(lounge):
    frames, poses = lounge
    kept = [reference_of(frame) for frame in frames]
    pairs = [(i, j) for i in range(len(kept)) for j in range(i + 1, min(i + 12, len(kept)))]
    shares = np.array([contradicted(kept[i], kept[j], "opencv") for i, j in pairs])
    assert np.isfinite(shares).sum() > 100
    assert np.nanmax(shares) < 0.1
    said, reference = observed(frames, poses)
    assert not said
    assert reference.is_settled


@pytest.mark.full
@pytest.mark.parametrize("convention", WRONG)
@pytest.mark.parametrize("first", [0, 8, 16, 24, 32])
def test_a_recording_in_another_convention_is_noticed(lounge, convention, first):
    frames, poses = lounge
    part = slice(first, first + 16)
    said, _ = observed(frames[part], [misread(T, convention) for T in poses[part]])
    assert len(said) == 1
    assert convention in said[0]


def in_room(position, yaw: float, pitch: float) -> r3jax.Frame:
    return frame_in_room(CAMERA, pose_at(position, yaw, pitch))


def poses_of(frames: list[r3jax.Frame]) -> list[np.ndarray]:
    return [np.asarray(frame.T_world_camera, np.float64) for frame in frames]


_places = st.tuples(st.floats(-2.0, 2.0), st.floats(-1.5, 1.5), st.floats(0.4, 2.2))
_middle = st.tuples(st.floats(-1.0, 1.0), st.floats(-0.8, 0.8), st.floats(1.0, 1.6))
_looks = st.tuples(_places, st.floats(-180.0, 180.0), st.floats(-60.0, 60.0))


@given(_looks, _looks)
def test_right_poses_never_contradict(one, other):
    frames = [in_room(*look) for look in (one, other)]
    first, second = map(reference_of, frames)
    assert not contradicted(first, second, "opencv") > 0.1  # NaN: they do not overlap
    assert not observed(frames, poses_of(frames))[0]


@given(
    st.lists(st.tuples(_places, st.floats(-180.0, 180.0), st.just(0.0)), min_size=8, max_size=12)
)
@settings(max_examples=25)
def test_a_level_camera_that_goes_from_place_to_place_is_not_warned_of(looks):
    """Views far apart seldom overlap; read backwards, walls fit by chance."""
    frames = [in_room(*look) for look in looks]
    assert not observed(frames, poses_of(frames))[0]


@given(_middle, st.floats(-180.0, 180.0), st.sampled_from(WRONG))
def test_wrong_poses_are_noticed_as_soon_as_the_camera_turns(place, yaw, convention):
    frames = [in_room(place, yaw + 15.0 * step, 10.0 * (step % 2)) for step in range(10)]
    said, reference = observed(frames, [misread(T, convention) for T in poses_of(frames)])
    assert len(said) == 1
    assert reference.is_settled  # it warns once
    assert not observed(frames, poses_of(frames))[0]


def test_backward_poses_of_a_robot_are_noticed_though_a_pair_fits_by_chance():
    """Views apart from each other do not settle the question while the camera is upside down."""
    places = [((-1.5, 0.0, 1.0), 180.0), ((1.5, 0.0, 1.0), 0.0), ((0.0, -1.0, 1.0), -90.0)]
    frames = [in_room(place, yaw, 0.0) for place, yaw in places]
    frames += [in_room((0.0, 0.0, 1.0), 40.0 * step, 0.0) for step in range(6)]
    said, _ = observed(frames, [misread(T, "opengl") for T in poses_of(frames)])
    assert len(said) == 1
    assert not observed(frames, poses_of(frames))[0]


def test_a_camera_that_stands_still_settles_nothing():
    frames = [in_room((0.0, 0.0, 1.0), 30.0, 0.0)] * 5
    said, reference = observed(frames, [misread(T, "opengl") for T in poses_of(frames)])
    assert not said
    assert not reference.is_settled


def test_frames_without_depth_settle_nothing():
    frames = [in_room((0.0, 0.0, 1.0), 20.0 * step, 0.0) for step in range(4)]
    frames = [replace(frame, depth=np.zeros_like(frame.depth)) for frame in frames]
    assert not observed(frames, poses_of(frames))[0]


def observe_all(planner: r3jax.Planner, frames: list[r3jax.Frame]) -> None:
    for frame in frames:
        planner = r3jax.observe(planner, frame)


def test_observe_warns_once():
    frames = [in_room((0.0, 0.0, 1.4), 15.0 * step, 10.0 * (step % 2)) for step in range(10)]
    poses = [misread(T, "opengl").astype(np.float32) for T in poses_of(frames)]
    wrong = [replace(f, T_world_camera=T) for f, T in zip(frames, poses, strict=True)]
    config = r3jax.MappingConfig(capacity=1 << 12, voxel_size=0.2, allow_growth=False)
    planner = r3jax.start(CAMERA, ROOM, "random", config=config)
    with pytest.warns(UserWarning, match="opengl") as caught:
        observe_all(planner, wrong)
    assert len(caught) == 1


@given(_looks, st.sampled_from(list(CONVENTIONS)))
def test_a_pose_of_any_convention_becomes_ours(look, convention):
    frame = in_room(*look)
    [pose] = poses_of([frame])
    made = r3jax.Frame.from_arrays(
        frame.rgb, frame.depth, misread(pose, convention), CAMERA, convention=convention
    )
    np.testing.assert_allclose(made.T_world_camera, pose, atol=1e-6)
