"""Active-GS (Jin et al., RA-L 2025), the planner that the paper compares with: on our maps."""

from r3jax.baselines.active_gs.policy import ActiveGS

__all__ = ["ActiveGS"]
