"""Runs begun, resumed, forked and merged: what the command line and the viewer share."""
