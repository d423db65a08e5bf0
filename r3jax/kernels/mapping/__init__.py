"""Integration of frames into a map, in machine code."""
