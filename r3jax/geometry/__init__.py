"""Pure math: cameras, directions, voxels. Imports nothing of r3jax."""
