"""Recordings of robots: ROS bags and RTAB-Map."""
