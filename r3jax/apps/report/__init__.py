"""The page that a run leaves behind, and what its images share with other pages."""
