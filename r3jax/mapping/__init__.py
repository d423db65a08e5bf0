"""What has been seen: the hashed voxel map and the coarse occupancy grid."""
