"""Starts the node, or says what is missing."""

import importlib.util

_NEEDED = ("rclpy", "message_filters", "tf2_ros", "nav2_msgs", "r3jax")


def missing() -> str:
    """Says which packages are missing and where they come from; empty: none."""
    absent = [name for name in _NEEDED if importlib.util.find_spec(name) is None]
    if not absent:
        return ""
    if absent == ["r3jax"]:
        return "r3jax is not installed in this Python: pip install r3jax"
    return (
        f"{', '.join(absent)} cannot be imported: source your ROS 2 installation first "
        "(source /opt/ros/DISTRO/setup.bash), and install what it lacks "
        "(apt install ros-DISTRO-navigation2 ros-DISTRO-tf2-ros-py ros-DISTRO-message-filters); "
        "without ROS use r3jax.start, observe and decide"
    )


def main() -> None:
    """Spins the node until it is interrupted."""
    problem = missing()
    if problem:
        raise SystemExit(f"r3jax_ros: {problem}")
    from r3jax_ros.node import spin

    spin()


if __name__ == "__main__":
    main()
