"""Guidance while a capture is taken: its progress, and where to go next."""
