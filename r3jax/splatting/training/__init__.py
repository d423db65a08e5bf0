"""Training of a scene of Gaussians: where it starts, its steps, its state on disk."""
