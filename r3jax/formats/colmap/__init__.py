"""COLMAP's sparse models: read, written, and made of a run."""
