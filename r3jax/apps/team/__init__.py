"""Explores one place with several cameras that exchange frames."""
