"""The command line: `r3jax demo | explore | info`."""

from r3jax.cli.main import main

__all__ = ["main"]
