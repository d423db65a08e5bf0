"""Hostile files for every reader: a table of readers, mutations, a worker that survives crashes."""
