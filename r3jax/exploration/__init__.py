"""The loop: decide, fly, look, remember. It knows worlds only as `simulators.base.Simulator`."""

from r3jax.exploration.loop import Result, explore

__all__ = ["Result", "explore"]
