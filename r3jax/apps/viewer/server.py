"""The web server of the viewer: by default for this machine and its own page only.

A browser lets any web page open a websocket to any address, this machine's too; and a page may
give its own name this machine's address (DNS rebinding). So every request says two things that are
looked at: under which name it was sent (Host), and which page sent it (Origin).
"""

import contextlib
import http
import http.client
import io
import ipaddress
import socket
import threading
from collections.abc import Callable, Collection, Generator
from typing import Any
from urllib.parse import urlsplit

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from r3jax.network import LOOPBACK, check_free, in_use


class _PrivateServer(viser.ViserServer):
    """Never opens a tunnel to the internet, even on a page's request."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Declines the request."""
        del verbose
        return None


def open_server(host: str, port: int, allow: Collection[str] = ()) -> viser.ViserServer:
    """Starts a server with an empty page.

    Args:
        host: the address to listen at; 127.0.0.1 can be reached from this machine only.
        port: 0 takes any free one.
        allow: host names under which the page may be requested, and whose pages may use it,
            beside this machine's own.

    Raises:
        ValueError: no number of a port.
        OSError: the port is in use or not permitted, or the address is not one of this machine.
    """
    check_free(host, port)  # viser tries a thousand ports, and any address without end
    # It would print a box of its own.
    with contextlib.redirect_stdout(io.StringIO()), _guarded(_Guard(host, allow)):
        server = _PrivateServer(host=host, port=port, label="r3jax", verbose=False)
    if port not in (
        0,
        server.get_port(),
    ):  # it was taken, and viser uses the next
        close_server(server)
        raise OSError(in_use(host, port))
    if _answer(server, f"{_STRANGER}:1") != http.HTTPStatus.FORBIDDEN:
        close_server(server)
        raise OSError("this version of viser lets any web page in: another one is needed")
    return server


_STRANGER = "stranger.invalid"

_Hook = Callable[[ServerConnection, Request], Any]


class _Guard:
    """Decides which requests are allowed."""

    def __init__(self, host: str, allow: Collection[str]):
        """Takes the address to listen at, and the names that are let in beside it."""
        self._is_open = host not in LOOPBACK
        own = (host, socket.gethostname(), f"{socket.gethostname()}.local") if self._is_open else ()
        self._allowed = {_bare(name) for name in allow}
        self._names = self._allowed | {_bare(name) for name in (*own, *LOOPBACK)}

    def refusal(self, request: Request) -> str | None:
        """Returns why a request is refused, or None if it is allowed."""
        hosts = request.headers.get_all("Host")
        origins = request.headers.get_all("Origin")
        if len(hosts) != 1 or len(origins) > 1:
            return "one Host and at most one Origin"
        name = _name(f"http://{hosts[0]}")
        # A public server is also requested by its address, and no page can own an address.
        if name not in self._names and not (self._is_open and _is_address(name)):
            return f"not served as {name!r}: r3jax view --allow {name}"
        if not origins or urlsplit(origins[0]).netloc.lower() == hosts[0].lower():
            return None
        page = _name(origins[0])
        return None if page in self._allowed else f"pages of {page!r} may not: --allow {page}"

    def hook(self, answer: _Hook | None) -> _Hook:
        """Returns a hook that checks every request, of pages and of websockets."""

        def process(connection: ServerConnection, request: Request) -> Response | None:
            reason = self.refusal(request)
            if reason is not None:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"refused: {reason}\n")
            return None if answer is None else answer(connection, request)

        return process


def _bare(name: str) -> str:
    return name.strip("[]").rstrip(".").lower()


def _name(url: str) -> str:
    """Returns the host name of a URL, without its port; empty if there is none."""
    try:
        return _bare(urlsplit(url).hostname or "")
    except ValueError:
        return ""


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


_PATCHING = threading.Lock()


@contextlib.contextmanager
def _guarded(guard: _Guard) -> Generator[None]:
    """Adds the check of host names while viser starts: viser itself has none."""
    serve = websockets.asyncio.server.serve

    def serve_guarded(*args: Any, process_request: _Hook | None = None, **options: Any) -> Any:
        return serve(*args, process_request=guard.hook(process_request), **options)

    with _PATCHING:
        websockets.asyncio.server.serve = serve_guarded
        try:
            yield
        finally:
            websockets.asyncio.server.serve = serve


def _answer(server: viser.ViserServer, host: str) -> int:
    """Requests the page under a host name and returns the HTTP status."""
    connection = http.client.HTTPConnection(_reachable(server), server.get_port(), timeout=10.0)
    try:
        connection.request("GET", "/", headers={"Host": host})
        return connection.getresponse().status
    finally:
        connection.close()


def close_server(server: viser.ViserServer) -> None:
    """Stops a server."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def url_of(server: viser.ViserServer) -> str:
    """Returns the URL of the page for a browser on this machine."""
    host = _reachable(server)
    return f"http://{f'[{host}]' if ':' in host else host}:{server.get_port()}"


def _reachable(server: viser.ViserServer) -> str:
    """Returns an address of this machine that the server listens on."""
    return {"0.0.0.0": "127.0.0.1", "::": "127.0.0.1"}.get(server.get_host(), server.get_host())
