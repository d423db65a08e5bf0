"""Guidance while a capture is taken: what is done, and where to go next."""
