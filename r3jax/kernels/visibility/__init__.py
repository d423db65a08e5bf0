"""Depth buffers of voxels round a position or before a camera, as kernels for CPUs."""
