"""Selects the frames of a capture to keep, so that its surfaces lose as little as possible."""
