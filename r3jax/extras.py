"""Optional packages, and the extras that install them."""

from collections.abc import Generator
from contextlib import contextmanager

EXTRAS = {
    "embreex": "sim",
    "gymnasium": "gym",
    "jaxopt": "refine",
    "jinja2": "plots",
    "matplotlib": "plots",
    "optax": "splats",
    "orbax": "splats",
    "trimesh": "sim",
}
"""The extra of r3jax that installs a package, by the name of its module."""


@contextmanager
def naming_extras() -> Generator[None]:
    """Adds the extra to install to the error of a missing package.

    Raises:
        ImportError: as it came, with the command that installs the package.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in EXTRAS:
            raise
        raise ImportError(
            f"{package} is not installed: pip install 'r3jax[{EXTRAS[package]}]', or 'r3jax[all]'",
            name=package,
        ) from error
