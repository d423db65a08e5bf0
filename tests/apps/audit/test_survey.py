"""Depth images against poses: a wrong unit is found by itself, a right one never."""

import numpy as np
import pytest

from r3jax.apps.audit.survey import DepthImage, check_agreement
from tests.apps.audit.room import LENS, picture, pose_at, round_poses
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
