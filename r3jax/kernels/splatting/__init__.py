"""Gaussians: projection, binning, sort, compositing, and all gradients."""
