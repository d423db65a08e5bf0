"""The loss of an image and Adam's step."""
