"""Data sets and recordings that are folders of numbered images: one module for each."""
