"""Backends of the rasteriser: the same numbers by different means."""
