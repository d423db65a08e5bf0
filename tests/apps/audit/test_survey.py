"""Depth images against poses: a wrong unit is found by itself, a right one never."""

import numpy as np
import pytest

from r3jax.apps.audit.source import source_of
from r3jax.apps.audit.survey import AuditSettings, DepthImage, check_agreement, survey_of
from r3jax.formats.recordings import read_recording
from tests.apps.audit.room import (
    LENS,
    picture,
    pose_at,
    round_poses,
    write_far_recording,
    write_recording,
)
from tests.conftest import shared_path

SHOWN = [(picture(pose)[1], pose) for pose in round_poses(16)]


def looks(factor: float = 1.0, turn: np.ndarray | None = None) -> list[DepthImage]:
    turn = np.eye(4) if turn is None else turn
    return [DepthImage(factor * depth, LENS.camera, pose @ turn) for depth, pose in SHOWN]


@pytest.mark.parametrize("factor", [5.0, 0.2, 2.0, 0.5, 1000.0, 0.001])
def test_a_wrong_unit_of_depth_is_refused_and_the_right_one_named(factor):
    with pytest.raises(ValueError, match="multiplied by") as refusal:
        check_agreement(looks(factor))
    named = float(str(refusal.value).partition("multiplied by ")[2].partition(":")[0])
    assert named == pytest.approx(1.0 / factor, rel=0.15)


def test_axes_of_another_convention_are_refused():
    with pytest.raises(ValueError, match="contradict"):
        check_agreement(looks(turn=np.diag([1.0, -1.0, -1.0, 1.0])))


def test_what_fits_is_let_through():
    rng = np.random.default_rng(0)
    check_agreement(looks())
    noisy = [look.depth * rng.normal(1.0, 0.01, look.depth.shape) for look in looks()]
    drifted = [pose.copy() for _, pose in SHOWN]
    for pose in drifted:
        pose[:3, 3] += rng.normal(0.0, 0.02, 3)
    check_agreement(
        [DepthImage(depth, LENS.camera, pose) for depth, pose in zip(noisy, drifted, strict=True)]
    )


def test_where_nothing_can_be_compared_nothing_is_said():
    eye = np.array([2.0, 1.5, 1.2])
    turned = [
        pose_at(eye, eye + np.array([np.cos(a), np.sin(a), 0])) for a in np.arange(0.0, 6.28, 0.4)
    ]
    check_agreement([DepthImage(5.0 * picture(pose)[1], LENS.camera, pose) for pose in turned])
    check_agreement(looks(5.0)[:1])
    check_agreement([DepthImage(0.0 * look.depth, look.camera, look.pose) for look in looks()])


def test_a_real_recording_fits_and_five_times_its_depth_does_not():
    from r3jax.apps.audit.source import source_of
    from r3jax.formats.recordings import read_recording

    source = source_of(read_recording(shared_path("recordings", "hololens_lounge"), "z"), "lounge")
    indices = np.linspace(0, len(source) - 1, 16).astype(int).tolist()
    real = [DepthImage(source.read(i)[1], source.camera(i), source.poses[i]) for i in indices]
    check_agreement(real)
    with pytest.raises(ValueError, match=r"multiplied by 0\.2"):
        check_agreement([DepthImage(5.0 * look.depth, look.camera, look.pose) for look in real])


def test_coordinates_of_utm_lose_an_origin_and_no_digits(tmp_path):
    """float32 would round them to half a meter."""
    far = np.array([500_000.0, 4_600_000.0, 100.0])
    near, source = (
        source_of(read_recording(path, "z"), path.name)
        for path in (
            write_recording(tmp_path / "near", round_poses()),
            write_far_recording(tmp_path / "far", round_poses(), far),
        )
    )
    settings = AuditSettings(voxel_size=0.2)
    one, other = survey_of(near, settings), survey_of(source, settings)
    assert not one.alignment.origin.any()
    assert np.abs(other.alignment.origin - far).max() < 10.0
    shift = (far - other.alignment.origin) * other.alignment.scale
    for index in (0, 5):
        first, second = near.frame(index, one.alignment), source.frame(index, other.alignment)
        np.testing.assert_allclose(
            np.asarray(second.position), np.asarray(first.position) + shift, atol=1e-5
        )
        np.testing.assert_array_equal(second.depth, first.depth)
    back = other.alignment.poses_back(other.alignment.poses(source.poses))
    np.testing.assert_allclose(back[:, :3, 3] - far, near.poses[:, :3, 3], atol=1e-7)
