"""Policies of others that keep a radiance field while they plan: theirs, never ours."""
