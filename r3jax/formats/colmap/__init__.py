"""Reads and writes COLMAP's sparse models, and makes them from runs."""
