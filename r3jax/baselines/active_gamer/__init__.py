"""ActiveGAMER on our map, and its pool of candidates."""

from r3jax.baselines.active_gamer.policy import ActiveGamer

__all__ = ["ActiveGamer"]
