"""Captures as phone and tablet apps export them, folders and archives: one module for each."""
