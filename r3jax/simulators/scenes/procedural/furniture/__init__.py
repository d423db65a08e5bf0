"""What stands and hangs in procedural rooms."""
