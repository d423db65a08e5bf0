"""Depth buffers of voxels, pinhole and panoramic: what a camera sees of a map."""
