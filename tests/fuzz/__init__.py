"""Hostile files for every reader: seeds, mutations, a worker process that survives crashes."""
