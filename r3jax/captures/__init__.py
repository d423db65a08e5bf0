"""Captures as frames of one world: reading, mapping, and finding faults."""
