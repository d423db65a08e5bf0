"""How scores are made fast on a platform; each backend is held to `reference`."""
