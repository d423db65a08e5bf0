"""The command line: `r3jax COMMAND`; the commands are listed in `main`."""

from r3jax.cli.main import main

__all__ = ["main"]
