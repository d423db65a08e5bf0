"""Ours, several views ahead."""

from r3jax.planning.policies.ahead.policy import OursAhead

__all__ = ["OursAhead"]
