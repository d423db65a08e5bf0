"""The ROS 2 node on a real rclpy: a process of its own, real topics, services and actions.

It skips without ROS; `docs/howto/robot.md` has the commands that install one from PyPI.
"""

import importlib
import itertools
import signal

import numpy as np
import pytest

for _name in ("rclpy", "nav2_msgs", "tf2_msgs"):
    pytest.importorskip(_name, reason=f"no {_name}: see docs/howto/robot.md, 'A real ROS 2'")

real = importlib.import_module("tests.ros.robot")

pytestmark = [
    pytest.mark.full,
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),  # of the wheels of ROS
]

CLOSED = 6.0
"""From this x on the costmap is closed [m]."""

SETTINGS = {"candidates": 20, "stride": 1, "patience": 30.0}


@pytest.fixture
def robot():
    with real.running(width=160, rate=10.0) as robot:
        yield robot


def close_part(robot) -> None:
    """Publishes a costmap."""
    grid = real.OccupancyGrid()
    grid.header.frame_id, grid.info.resolution = "map", 0.1
    grid.info.width, grid.info.height, grid.info.origin.orientation.w = 90, 50, 1.0
    cost = np.zeros((50, 90), np.int8)
    cost[:, int(CLOSED / 0.1) :] = 100
    grid.data.frombytes(cost.tobytes())
    robot.costmap.publish(grid)


def ask(robot, explorer, name: str):
    """Calls a service of the node."""
    client = robot.ask[name]
    real.wait_for(client.service_is_ready, 60.0, f"service {name}")
    answer = client.call_async(real.Trigger.Request())
    real.wait_for(answer.done, 60.0, f"an answer of {name}; the node says {explorer.said[-2000:]}")
    return answer.result()


def test_the_node_explores_on_a_real_ros(robot, tmp_path):
    close_part(robot)  # before there is a node: it gets what is latched
    settings = real.parameters_of(robot) | SETTINGS | {"autostart": False, "map_file": "planner"}
    explorer = real.Explorer(tmp_path, "--log-level", "r3jax:=debug", **settings)
    try:
        mission(robot, explorer)
        assert explorer.stop(signal.SIGINT) == 0, explorer.said
    finally:
        explorer.process.kill()
        explorer.process.wait()
    real.wait_for(
        lambda: robot.results[-1] == real.GoalStatus.STATUS_CANCELED, 5.0, "a robot that stops"
    )
    assert "Traceback" not in explorer.said


def mission(robot, explorer) -> None:
    """Starts, drives, is refused, stops, saves, loads, closes a loop; ends on the way to a goal."""
    until = lambda what, why: real.wait_for(
        what, 90.0, f"{why}; the node says {explorer.said[-2000:]}"
    )
    arrived = lambda: robot.results.count(real.GoalStatus.STATUS_SUCCEEDED)
    until(lambda: "mapped" in explorer.said, "a key frame")
    assert not robot.goals
    assert ask(robot, explorer, "start").success
    until(lambda: arrived() >= 2, "two goals")

    robot.is_refusing, before = True, len(robot.goals)
    until(lambda: len(robot.goals) >= before + 2, "another goal after one that was refused")
    first, second = robot.goals[before : before + 2]
    assert not np.allclose(first, second, atol=1e-3)
    robot.is_refusing, before = False, arrived()
    until(lambda: arrived() > before, "a goal")

    robot.is_blocked = True
    until(lambda: robot.drives, "a robot that is on its way")
    assert ask(robot, explorer, "stop").success
    until(lambda: not robot.drives, "a robot that stands")
    assert robot.results[-1] == real.GoalStatus.STATUS_CANCELED
    for name in ("save", "load"):
        answer = ask(robot, explorer, name)
        assert answer.success, answer.message
    assert (explorer.file.parent / "planner").exists()
    robot.is_blocked, before = False, arrived()
    assert ask(robot, explorer, "start").success
    until(lambda: arrived() > before, "a goal of the planner that was loaded")

    shifts = itertools.cycle((0.0, 0.1))

    def is_closed() -> bool:
        path_of(robot, next(shifts))
        robot.next_image()
        return "loop closed" in explorer.said

    until(is_closed, "a closed loop")
    before = arrived()
    until(lambda: arrived() > before, "a goal after the loop closed")
    robot.is_blocked = True
    until(lambda: robot.drives, "a robot that is on its way")
    check_messages(robot)


def path_of(robot, shift: float) -> None:
    """Publishes where the robot was in the last two minutes, every half a second."""
    real.wait_for(robot.path.get_subscription_count, 10.0, "a subscriber of the path")
    path, now = real.PathMessage(), robot.get_clock().now().nanoseconds
    for stamp in range(now - 120_000_000_000, now + 1_000_000_000, 500_000_000):
        pose = real.PoseStamped()
        pose.header.stamp.sec, pose.header.stamp.nanosec = divmod(stamp, 1_000_000_000)
        pose.pose.position.x, pose.pose.orientation.w = shift, 1.0
        path.poses.append(pose)
    robot.path.publish(path)


def check_messages(robot) -> None:
    """The last goal comes late, too; the three topics agree with what Nav2 was sent."""
    late = []
    robot.create_subscription(real.OUT["next_goal"], "next_goal", late.append, real.LATCHED)
    real.wait_for(lambda: late, 10.0, "the last goal, for a late subscriber")
    last = robot.goals[-1]
    np.testing.assert_allclose([late[-1].pose.position.x, late[-1].pose.position.y], last[:2, 3])
    assert late[-1].header.frame_id == "map"
    view = (last @ robot.T_base_camera)[:3, 3]
    np.testing.assert_allclose(real.line(robot.received["next_view"][-1])[-1], view, atol=1e-3)
    assert max(goal[0, 3] for goal in robot.goals) < CLOSED
    cloud = robot.received["map_points"][-1]
    points = np.frombuffer(bytes(cloud.data), "<f4").reshape(cloud.width, 4)[:, :3]
    lower, upper = np.asarray(robot.world.bounds)
    assert len(points) > 1000
    is_inside = ((points > lower - 0.2) & (points < upper + 0.2)).all(axis=1)
    assert is_inside.mean() > 0.95  # the closure moved the map by 0.1 m
