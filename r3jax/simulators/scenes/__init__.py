"""Where worlds come from: procedural rooms, mesh files, the Replica dataset."""
