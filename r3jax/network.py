"""Addresses at which pages are served: by default for this machine only."""

import errno
import socket

from r3jax.errors import InputError

LOOPBACK = ("127.0.0.1", "::1", "localhost")
"""Addresses that no other machine can reach."""


def exposure_warning(host: str, what: str = "sees the page") -> str | None:
    """Warns of a server that other machines can reach; None if they cannot.

    Args:
        host: the address to listen at.
        what: others do then.
    """
    return None if host in LOOPBACK else f"everybody who can reach {host} {what}"


def check_free(host: str, port: int) -> None:
    """Refuses a port or address that cannot be listened at now.

    Raises:
        ValueError: no number of a port.
        OSError: the port is in use or not permitted, or the address is not one of this machine;
            says what to do.
    """
    if not 0 <= port <= 65535:
        raise InputError(f"--port must lie between 0 and 65535, got {port}")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except OSError as error:
        raise OSError(f"--host {host!r} is no address of a machine ({error})") from None
    try:
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except PermissionError:
        raise OSError(f"port {port} is reserved: give another one with --port") from None
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise OSError(in_use(host, port)) from None
        raise OSError(f"cannot listen at {host}:{port} ({error.strerror})") from None


def in_use(host: str, port: int) -> str:
    """Describes the error that the port is in use."""
    return f"port {port} of {host} is in use: give another one with --port, or 0 for any"
