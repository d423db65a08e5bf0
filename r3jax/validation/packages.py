"""Packages that are only needed for some files."""


def why_not_imported(error: ImportError, package: str, what_for: str, extra: str) -> str:
    """Says why a package cannot be imported, and the command that mends it.

    Args:
        error: what importing it raised.
        package: its name, which is the module's too.
        what_for: the beginning of the sentence, such as "ROS bags are read by".
        extra: the extra of r3jax that installs it.
    """
    if isinstance(error, ModuleNotFoundError) and error.name == package:
        return f"{what_for} {package}, which is not installed: pip install 'r3jax[{extra}]'"
    return (
        f"{what_for} {package}, which is installed but cannot be imported ({error!s:.200}): "
        f"pip install --force-reinstall 'r3jax[{extra}]'"
    )
