"""Checks of foreign files before a reader trusts them."""
