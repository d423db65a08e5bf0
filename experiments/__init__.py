"""One file per table or figure; run as `python -m experiments.NAME` from the repository's root."""
