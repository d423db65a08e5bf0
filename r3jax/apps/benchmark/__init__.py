"""Runs benchmarks: scenes x policies x seeds on equal terms; each cell is recorded once."""
