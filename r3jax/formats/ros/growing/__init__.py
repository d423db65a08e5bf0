"""Bags that are being recorded: what is in them already, record by record."""
