"""Where worlds come from: procedural rooms and mesh files."""
