"""Pictures of the documentation, each made by a command from the repository's root."""
