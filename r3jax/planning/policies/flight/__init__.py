"""Ours, whole flights: what all frames of a path show, and not only the view at its end."""

from r3jax.planning.policies.flight.policy import OursPath

__all__ = ["OursPath"]
