"""Worlds that answer with RGB-D frames. Only here are trimesh, embreex and habitat_sim imported."""
