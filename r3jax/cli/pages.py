"""What the commands that show a page have in common."""

import importlib.util

from r3jax.cli.errors import UserError


def check_viser() -> None:
    """Refuses to go on without viser.

    Raises:
        UserError: it is not installed; the message says how to get it.
    """
    if importlib.util.find_spec("viser") is None:
        raise UserError(
            "the viewer needs viser, which is not installed: pip install 'r3jax[viewer]'"
        )
