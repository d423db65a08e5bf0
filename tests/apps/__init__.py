"""Tests of what is built on the flow."""
