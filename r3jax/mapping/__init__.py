"""The hashed voxel map and the coarse occupancy grid."""
