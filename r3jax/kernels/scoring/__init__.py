"""Scores of many views of one map, in machine code."""
