"""Trained models in their folders, and their judgment by test views."""
