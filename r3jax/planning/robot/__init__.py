"""The robot: where it can go, how it may look, and what it could ever see."""
