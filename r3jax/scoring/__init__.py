"""Closed forms: how well a view could be rendered, and what it would add to the map."""
