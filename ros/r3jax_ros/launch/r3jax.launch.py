"""Starts the explorer beside a running Nav2, a camera and a SLAM system; RViz if asked for.

ros2 launch r3jax_ros r3jax.launch.py color:=/camera/color/image_raw rviz:=true
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

TOPICS = {
    "color": "/camera/color/image_raw",
    "depth": "/camera/aligned_depth_to_color/image_raw",
    "camera_info": "/camera/color/camera_info",
    "path": "/rtabmap/mapPath",
    "costmap": "/global_costmap/costmap",
}


def generate_launch_description():
    """Describes the node, its parameters and its topics."""
    share = Path(get_package_share_directory("r3jax_ros"))
    arguments = [DeclareLaunchArgument(name, default_value=topic) for name, topic in TOPICS.items()]
    arguments += [
        DeclareLaunchArgument("params", default_value=str(share / "config" / "r3jax.yaml")),
        DeclareLaunchArgument("rviz", default_value="false"),
    ]
    explorer = Node(
        package="r3jax_ros",
        executable="explorer",
        name="r3jax",
        output="screen",
        parameters=[LaunchConfiguration("params")],
        remappings=[(name, LaunchConfiguration(name)) for name in TOPICS],
    )
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", str(share / "rviz" / "r3jax.rviz")],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    return LaunchDescription([*arguments, explorer, rviz])
