"""Hostile files for every reader: seeds, mutations, a worker process that survives crashes.

A reader has a file `test_NAME.py` with `seeds()` (small valid trees of files), `read(folder)`
(reads one, and fails an assertion where the values make no sense) and `READER` (both, and the
reader's own errors). Readers of transforms.json and of COLMAP get theirs when they come.
"""
