"""The public call: frames in, arrays out."""

import numpy as np
import pytest

import r3jax
from r3jax.apps.select.select import _adds
from tests.apps.audit.room import FOCAL, HEIGHT, WIDTH, picture, round_poses

K = [[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]]


def frames_of(poses):
    found = []
    for pose in poses:
        rgb, depth = picture(pose)
        found.append(r3jax.Frame.from_arrays(rgb, depth.astype(np.float32), pose, K))
    return found


@pytest.fixture(scope="module")
def frames():
    return frames_of(round_poses(10))


def test_the_order_of_the_frames_does_not_matter(frames):
    found = r3jax.select_frames(frames, 4, voxel_size=0.15)
    order = np.random.default_rng(0).permutation(len(frames))
    again = r3jax.select_frames([frames[i] for i in order], 4, voxel_size=0.15)
    assert set(order[again.order].tolist()) == set(found.order.tolist())
    np.testing.assert_allclose(again.renderability, found.renderability, atol=1e-5)


def test_the_targets_render_nearly_as_well_on_a_map_of_the_frames_chosen(frames):
    poses = np.stack([np.asarray(frame.T_world_camera) for frame in frames[:3]])
    found = r3jax.select_frames(frames, 5, targets=poses, voxel_size=0.15)
    m = r3jax.empty_map(capacity=1 << 13, voxel_size=0.15)
    for i in found.order:
        m = r3jax.integrate(m, frames[i], 5.0)
    for pose, value in zip(poses, found.per_target[-1], strict=True):
        # That map knows fewer surfaces to hide others, and another buffer draws it.
        told = float(r3jax.renderability(m, frames[0].camera, pose))
        assert value == pytest.approx(told, abs=0.05)


def test_of_two_frames_from_one_place_the_sharp_one_is_chosen(frames):
    first = int(r3jax.select_frames(frames, 1, voxel_size=0.15).order[0])
    blur = np.ones(len(frames) + 1)
    blur[first] = 6.0
    twins = [*frames, frames[first]]
    assert r3jax.select_frames(twins, 1, blur=blur, voxel_size=0.15).order[0] == len(frames)


def test_blur_counts_from_the_very_place_of_a_frame(frames):
    own = np.asarray(frames[0].T_world_camera)[None]
    seen = lambda blur: r3jax.select_frames(
        frames[:1], 1, targets=own, blur=[blur], voxel_size=0.15
    ).renderability[-1]  # fmt: skip
    assert seen(4.0) == pytest.approx(seen(1.0) / 4.0, rel=0.02)


@pytest.mark.parametrize(("settings", "named"), [
    ({"num": 0}, "frames"),
    ({"num": 2, "share": 0.5}, "share"),
    ({"num": 2, "keep": [99]}, "keep"),
    ({"num": 2, "blur": [1.0]}, "blur"),
    ({"num": 2, "targets": np.eye(4)}, "targets"),
])  # fmt: skip
def test_wrong_arguments_are_refused(frames, settings, named):
    with pytest.raises(ValueError, match=named):
        r3jax.select_frames(frames, **settings)


def test_no_frames_are_refused():
    with pytest.raises(ValueError, match="no frames"):
        r3jax.select_frames([])


@pytest.mark.parametrize("num", [10, 300, 5_000, 200_000])
def test_what_a_frame_of_average_use_adds_is_never_nothing(num):
    word, percent, _ = _adds(1.0 / num, num).split()
    assert word == "adds"
    assert float(percent) == pytest.approx(100.0 / num, rel=0.35)  # one digit
    assert _adds(0.01 / num, num) == "adds nothing"
