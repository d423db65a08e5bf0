"""Backends of the rasterizer, with the same results."""
