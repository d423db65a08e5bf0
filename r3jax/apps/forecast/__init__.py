"""Predicts the quality of models of the views so far, from the map alone."""
