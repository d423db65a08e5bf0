"""Tests of whole flights."""
