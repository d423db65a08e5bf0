"""What a run achieved: metrics, test views and statistics, the evaluation protocol."""
