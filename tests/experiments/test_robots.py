"""A robot with a footprint goes everywhere that it fits, and touches nothing of the true mesh."""

import numpy as np
import pytest

from experiments.robots import PIXEL, Plan, Robot, after, drive, near_path, plan_of, scene_world

pytestmark = pytest.mark.full


@pytest.mark.parametrize(
    ("scene", "robot", "decisions", "least"),
    [
        ("flat", Robot(height=0.3), 30, 0.8),
        ("flat", Robot(height=0.9, tilt=-20.0), 30, 0.8),
        # Within 60 decisions it is four fifths here, too; that takes minutes.
        ("office", Robot(height=0.6), 20, 0.5),
    ],
)
def test_a_robot_visits_most_places_and_touches_nothing(scene, robot, decisions, least):
    result = drive(scene_world(scene), robot, after(robot), decisions)
    assert result["outcome"] == "moved"
    assert result["visited"] >= least
    assert result["nearest"] >= robot.footprint - 0.75 * PIXEL


def test_the_plan_of_the_true_mesh_has_its_walls_and_what_is_near_goes_round_them():
    plan = plan_of(scene_world("flat"), 0.0, 0.0, 0.5)
    # The middle of the flat is a meter from everything, its outer wall is not.
    assert plan.at(np.array([[3.9, 2.2], [0.0, 2.2]])).tolist() == pytest.approx(
        [1.0, 0.0], abs=0.3
    )
    distance = np.full((200, 100), 1.0)
    distance[100, :95] = 0.0
    divided = Plan(np.zeros(2), distance)
    reachable = divided.reachable(0.5, np.array([0.5, 0.5]))
    near = near_path(reachable, np.array([[98, 10]]))
    assert near[60, 10]
    assert not near[110, 10]  # behind the wall, though 24 cm away
