"""Other people's files: recordings and datasets."""
