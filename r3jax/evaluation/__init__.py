"""Evaluation: metrics, test views, statistics and the protocol."""
