"""The page that a run leaves behind, and what its pictures share with other pages."""
