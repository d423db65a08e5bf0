"""Backends of the rasterizer: the same numbers by different means."""
