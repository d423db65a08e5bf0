"""Limits: what is allowed stays, what is not becomes the nearest view that is, and costs by hand.

The oracle of angles is SciPy's, in float64.
"""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.planning.candidates import poses_along
from r3jax.planning.robot import limits as limits_module
from r3jax.planning.robot.motion import MOTIONS, Motion
from tests.planning.rooms import candidates_of

NUM = 24
LATTICE = fibonacci_lattice(526)
TURNING = Motion(elevations=(-60.0, 20.0), turn_per_meter=90.0)
MOTIONS_TRIED = [*MOTIONS.values(), TURNING, Motion(elevations=(-15.0, -15.0))]


def views(seed: int, spread: float = 1.0) -> np.ndarray:
    """Poses within `spread` [m] that look anywhere; some straight up or down; [NUM, 4, 4]."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(NUM, 3))
    directions[:2] = [[0, 0, 1], [0, 0, -1]]
    return poses_along(rng.uniform(-spread, spread, (NUM, 3)), directions)


def limited(module, motion: Motion, seed: int):
    now = views(seed + 1000)[5]
    now[2, 3] = 0.1
    return module.Limits(motion, module.begin_at(motion, now), motion.heights_from(0.1))


def feasible(limits, poses: np.ndarray) -> np.ndarray:
    """The poses of the nearest views that are allowed."""
    return limits.project_to_feasible(candidates_of(poses)).T_world_camera


def elevation(poses: np.ndarray) -> np.ndarray:
    """Above the horizon [deg]."""
    return np.degrees(np.arcsin(np.clip(poses[..., 2, 2], -1.0, 1.0)))


def turn(first: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Angle of the rotation to each pose [deg]."""
    relative = Rotation.from_matrix(first[:3, :3]).inv() * Rotation.from_matrix(poses[:, :3, :3])
    return np.degrees(relative.magnitude())


def is_allowed(limits, poses: np.ndarray, slack: float) -> np.ndarray:
    """Which poses keep to all limits but for `slack` degrees."""
    motion, height = limits.motion, poses[:, 2, 3]
    low, high = motion.elevations
    fine = (elevation(poses) >= low - slack) & (elevation(poses) <= high + slack)
    fine &= (height >= limits.heights[0]) & (height <= limits.heights[1])
    if motion.turn_per_meter is not None:
        straight = np.linalg.norm(poses[:, :3, 3] - limits.T_world_camera[:3, 3], axis=1)
        fine &= turn(limits.T_world_camera, poses) <= motion.turn_per_meter * straight + slack
    return fine


@given(st.integers(0, 1000))
def test_any_view_becomes_an_allowed_one(seed):
    """Allowed and without roll; what was allowed is left as it is; a second time nothing moves."""
    for motion in MOTIONS_TRIED:
        limits = limited(limits_module, motion, seed)
        for spread in (0.05, 1.0, 5.0):
            poses = views(seed, spread)
            before = poses.copy()
            obeyed = feasible(limits, poses)
            np.testing.assert_array_equal(poses, before)
            # float32 poses know angles near none and near straight up to some hundredths only.
            assert is_allowed(limits, obeyed, 0.1).all()
            np.testing.assert_allclose(obeyed[:, 2, 0], 0.0, atol=1e-6)
            rotation = obeyed[:, :3, :3]
            np.testing.assert_allclose(
                rotation @ np.swapaxes(rotation, 1, 2), np.tile(np.eye(3), (NUM, 1, 1)), atol=1e-6
            )
            assert np.all(obeyed[:, 2, 1] <= 1e-6)  # nobody's head is down
            was_fine = is_allowed(limits, poses, -0.1)
            np.testing.assert_allclose(obeyed[was_fine], poses[was_fine], atol=1e-6)
            np.testing.assert_allclose(feasible(limits, obeyed), obeyed, atol=1e-6)
            np.testing.assert_array_equal(obeyed[:, :2, 3], poses[:, :2, 3])


def test_nearest() -> None:
    """By hand: 45 degrees up become 30; half a turn at 0.5 m becomes 45 degrees that way."""
    module, here = limits_module, np.zeros(3)
    now = poses_along(here[None], np.array([[1.0, 0.0, 0.0]]))[0]
    tilted = module.Limits(MOTIONS["gimbal"], now)
    up = poses_along(here[None], np.array([[0.0, -1.0, 1.0]]))
    half = math.sqrt(0.75)
    np.testing.assert_allclose(feasible(tilted, up)[0, :3, 2], [0.0, -half, 0.5], atol=1e-6)
    walking = module.Limits(Motion(turn_per_meter=90.0), now)
    place = np.array([[0.3, 0.4, 0.0]])
    back = poses_along(place, np.array([[-1.0, 1e-3, 0.0]]))
    root = math.sqrt(0.5)
    np.testing.assert_allclose(feasible(walking, back)[0, :3, 2], [root, root, 0.0], atol=1e-6)
    # Across the azimuth where the angles begin again: 20 degrees are 20, not 340.
    wrapped = module.Limits(Motion(turn_per_meter=90.0), _level(170.0, here))
    there = _level(-170.0, place[0])[None]
    np.testing.assert_allclose(feasible(wrapped, there), there, atol=1e-6)


def _level(degrees: float, place: np.ndarray) -> np.ndarray:
    angle = math.radians(degrees)
    return poses_along(place[None], np.array([[math.cos(angle), math.sin(angle), 0.0]]))[0]


@pytest.mark.full
@given(st.integers(0, 1000))
def test_any_place_has_its_allowed_axes(seed):
    """A direction is allowed where it, or one within its bin, is; somewhere there is always one."""
    positions = views(seed, 0.5)[:, :3, 3]
    cap = math.degrees(math.acos(1.0 - 2.0 / 526.0))
    for motion in MOTIONS_TRIED:
        limits = limited(limits_module, motion, seed)
        positions[:, 2] = np.clip(positions[:, 2], *limits.heights)
        axes = limits.allowed_axes(positions, len(LATTICE))
        assert axes.shape == (NUM, 526)
        assert axes.any(axis=1).all()
        for position, allowed in zip(positions[:6], axes[:6], strict=True):
            poses = poses_along(np.tile(position, (526, 1)), LATTICE)
            assert allowed[is_allowed(limits, poses, -0.1)].all()
            # A turn cut short is no shortest one: between the poles its end may lie farther off.
            far = ~is_allowed(limits, poses, 3.0 * cap)
            assert allowed[far].sum() <= 1
        if motion.turn_per_meter is None:
            shift = np.maximum(
                elevation_of(LATTICE) - motion.elevations[1],
                motion.elevations[0] - elevation_of(LATTICE),
            )
            np.testing.assert_array_equal(axes[0], shift <= cap)

    # Who cannot turn at all and looks into the widest gap of the lattice has the nearest axis.
    anywhere = np.random.default_rng(seed).normal(size=(4000, 3))
    anywhere /= np.linalg.norm(anywhere, axis=1, keepdims=True)
    gap = anywhere[np.argmin((anywhere @ LATTICE.T).max(axis=1))]
    now = poses_along(np.zeros((1, 3)), gap[None])[0]
    still = limits_module.Limits(Motion(turn_per_meter=90.0), now)
    (axes,) = still.allowed_axes(np.zeros((1, 3)), len(LATTICE))
    np.testing.assert_array_equal(np.flatnonzero(axes), [np.argmax(LATTICE @ gap)])


def elevation_of(directions: np.ndarray) -> np.ndarray:
    return np.degrees(np.arcsin(directions[:, 2]))


@given(st.integers(0, 1000))
def test_a_turn_takes_its_time(seed):
    """Where the carrier may turn far enough is where the elevation alone settles the view."""
    positions, directions = views(seed)[:, :3, 3], LATTICE[::40]
    limits = limited(limits_module, TURNING, seed)
    may = limits.may_turn(positions[:, None, :], directions)
    gimbal = limits_module.Limits(Motion(elevations=TURNING.elevations))
    for position, row in zip(positions, may, strict=True):
        poses = poses_along(np.tile(position, (len(directions), 1)), directions)
        settled = feasible(gimbal, poses)
        straight = np.linalg.norm(position - limits.T_world_camera[:3, 3])
        gap = 90.0 * straight - turn(limits.T_world_camera, settled)
        clear = np.abs(gap) > 0.1
        np.testing.assert_array_equal(row[clear], gap[clear] > 0.0)
    assert may.any()
    assert not may.all()
    assert limited(limits_module, MOTIONS["ground"], seed).may_turn(positions, LATTICE[:1]).all()


def test_costs() -> None:
    """By hand: at 2 m/s and 45 degrees/s a quarter turn takes 2 s, in which 4 m could be flown."""
    here = np.zeros(3)
    poses = np.stack([_level(0.0, here), _level(90.0, here), _level(180.0, here)])
    limits = limits_module.Limits(Motion(speed=2.0, turn_rate=45.0), poses[0])
    lengths = np.array([1.0, 1.0, np.inf])
    axes = poses[:, :3, 2]
    np.testing.assert_allclose(limits.path_costs(lengths, axes), [1.0, 5.0, np.inf], rtol=1e-6)
    assert limits.seconds(3.0, axes[1]) == pytest.approx(1.5 + 2.0, rel=1e-6)
    free = limits_module.Limits()
    np.testing.assert_array_equal(free.path_costs(lengths, axes), lengths)
    assert free.seconds(3.0, axes[1]) is None


def test_begin() -> None:
    """A mission begins at an allowed elevation, whatever the turn; not at a height beyond reach."""
    begin_at, steep = limits_module.begin_at, views(3)[7]
    for motion in (*MOTIONS_TRIED, Motion(elevations=(-5.0, 5.0), turn_per_meter=10.0)):
        pose = begin_at(motion, steep)
        low, high = motion.elevations
        assert low - 1e-3 <= elevation(pose) <= high + 1e-3
        np.testing.assert_array_equal(pose[:3, 3], steep[:3, 3])
    np.testing.assert_array_equal(begin_at(Motion(), steep), steep)
    world = Motion(heights=(4.0, 5.0), heights_above="world")
    try:
        begin_at(world, steep)
        said = "nothing"
    except ValueError as error:
        said = str(error)
    assert "4.000 to 5.000 m" in said
