"""r3jax as a ROS 2 node."""
