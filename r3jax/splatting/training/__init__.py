"""Training of a scene of Gaussians: initialization, steps, checkpoints."""
