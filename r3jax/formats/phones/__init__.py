"""Captures exported by phone and tablet apps, as folders and archives: one module per app."""
