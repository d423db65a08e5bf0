"""What carries the camera: where it can go, how it may look, and what it could ever see."""
