"""The web server of the viewer: on this machine only, unless told otherwise."""

import contextlib
import errno
import io
import socket

import viser

LOOPBACK = ("127.0.0.1", "::1", "localhost")
"""Addresses that no other machine can reach."""


class _PrivateServer(viser.ViserServer):
    """Never opens a tunnel to the internet, whoever asks for it."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Declines."""
        del verbose
        return None


def open_server(host: str, port: int) -> viser.ViserServer:
    """Starts a server with an empty page.

    Args:
        host: the address to listen at; nobody else can reach what listens at 127.0.0.1.
        port: 0 takes any free one.

    Raises:
        ValueError: no number of a port.
        OSError: the port is in use or not permitted, or the address is not one of this machine.
    """
    if not 0 <= port <= 65535:
        raise ValueError(f"--port must lie between 0 and 65535, got {port}")
    _check_free(host, port)
    with contextlib.redirect_stdout(io.StringIO()):  # it would print a box of its own
        server = _PrivateServer(host=host, port=port, label="r3jax", verbose=False)
    if port not in (0, server.get_port()):  # taken meanwhile: it has gone on to the next one
        close_server(server)
        raise OSError(_in_use(host, port))
    return server


def close_server(server: viser.ViserServer) -> None:
    """Stops a server."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def _check_free(host: str, port: int) -> None:
    """Refuses what the server would not: it tries a thousand ports, and any address for ever."""
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
            raise OSError(_in_use(host, port)) from None
        raise OSError(f"cannot listen at {host}:{port} ({error.strerror})") from None


def _in_use(host: str, port: int) -> str:
    return f"port {port} of {host} is in use: give another one with --port, or 0 for any"


def url_of(server: viser.ViserServer) -> str:
    """Where a browser on this machine finds the page."""
    host = server.get_host()
    if host in ("0.0.0.0", "::"):
        host = "127.0.0.1"
    return f"http://{f'[{host}]' if ':' in host else host}:{server.get_port()}"
