"""The robot: where it can go, its allowed views, and which cells it could ever see."""
