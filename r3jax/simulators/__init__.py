"""Simulates worlds as RGB-D frames. Only this package imports trimesh, embreex and habitat_sim."""
