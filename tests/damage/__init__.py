"""What kills, torn files and flipped bits may do to what lies on disk."""
