"""How the commands print."""

from typing import Any

PLAIN: dict[str, Any] = {"highlight": False, "markup": False, "soft_wrap": True}
"""Text as it is: paths must stay whole for copying."""
