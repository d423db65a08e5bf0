"""What a run achieved: figures and the report."""
