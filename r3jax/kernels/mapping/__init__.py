"""A frame joins a map, in machine code."""
