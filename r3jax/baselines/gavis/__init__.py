"""GAVIS (CVPR 2026, arXiv 2605.30342), its field of visibility in closed form on our maps."""

from r3jax.baselines.gavis.policy import Gavis, GavisConfig

__all__ = ["Gavis", "GavisConfig"]
