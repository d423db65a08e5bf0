"""Worlds that answer with RGB-D frames: the only place that imports trimesh, embreex, habitat_sim."""
