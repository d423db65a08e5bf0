"""Audit of an existing capture: where splats of it would fail, and which views would mend it."""
