"""Tables and figures of a benchmark's cells."""
