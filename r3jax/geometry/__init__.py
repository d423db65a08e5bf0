"""Pure maths: cameras, directions, voxels. Imports nothing of r3jax."""
