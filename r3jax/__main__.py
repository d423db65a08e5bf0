"""`python -m r3jax`, where the command `r3jax` is not on the path."""

import sys

from r3jax.cli import main

if __name__ == "__main__":
    sys.exit(main())
