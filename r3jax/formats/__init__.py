"""Readers and writers of captures, recordings and data sets."""
