"""Who can reach the page, and what is said when nobody can."""

import http.client
import socket
import urllib.request
from pathlib import Path

import pytest

pytest.importorskip("viser", reason="the viewer needs viser, which is not installed")

from r3jax.apps.viewer.server import close_server, open_server, url_of


@pytest.fixture
def server():
    server = open_server("127.0.0.1", 0)
    yield server
    close_server(server)


def addresses_of_this_machine() -> set[str]:
    try:
        found = socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)
    except OSError:
        return set()
    return {str(entry[4][0]) for entry in found} - {"127.0.0.1", "127.0.1.1"}


def test_the_page_is_served_at_its_address(server):
    assert url_of(server) == f"http://127.0.0.1:{server.get_port()}"
    with urllib.request.urlopen(url_of(server), timeout=30) as answer:
        assert b"<html" in answer.read()


def test_only_this_machine_can_reach_it(server):
    sockets = Path("/proc/net/tcp").read_text().splitlines()[1:]
    here = f"{server.get_port():04X}"
    listening = [line.split()[1] for line in sockets if line.split()[3] == "0A"]
    mine = [address for address in listening if address.endswith(f":{here}")]
    assert mine == [f"0100007F:{here}"]
    for address in addresses_of_this_machine():
        with pytest.raises(OSError, match="refused"):
            socket.create_connection((address, server.get_port()), timeout=10)


def ask(server, upgrade=False, **headers) -> int:
    """Status of the answer to a page (200 where it is served) or to a websocket (101)."""
    connection = http.client.HTTPConnection("127.0.0.1", server.get_port(), timeout=30)
    port = server.get_port()
    fields = {"Host": f"127.0.0.1:{port}"} if "Host" not in headers else {}
    fields |= {name: value.format(port=port) for name, value in headers.items()}
    if upgrade:
        fields |= {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
        fields |= {"Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ=="}
    connection.putrequest("GET", "/", skip_host=True)
    for name, value in fields.items():
        connection.putheader(name, value)
    connection.endheaders()
    status = connection.getresponse().status
    connection.close()
    return status


FOREIGN = {
    "another page": {"Origin": "http://evil.example"},
    "another page of this machine": {"Origin": "http://127.0.0.1:1"},
    "a page of nobody": {"Origin": "null"},
    "another name": {"Host": "evil.example"},
    "another name and its page": {
        "Host": "evil.example:{port}",
        "Origin": "http://evil.example:{port}",
    },
    "an address of another": {"Host": "192.0.2.1:{port}"},
    "nonsense": {"Host": "[:::{port}"},
}
OWN = {
    "no browser": {},
    "its own page": {"Origin": "http://127.0.0.1:{port}"},
    "a tunnel": {"Host": "localhost:9000", "Origin": "http://localhost:9000"},
    "the other loopback": {"Host": "[::1]:{port}", "Origin": "http://[::1]:{port}"},
}


@pytest.mark.parametrize("headers", FOREIGN.values(), ids=FOREIGN)
def test_other_web_pages_are_refused(server, headers):
    assert ask(server, **headers) == 403
    assert ask(server, upgrade=True, **headers) == 403


@pytest.mark.parametrize("headers", OWN.values(), ids=OWN)
def test_its_own_page_is_served(server, headers):
    assert ask(server, **headers) == 200
    assert ask(server, upgrade=True, **headers) == 101


def test_an_open_server_answers_to_addresses_and_to_the_names_that_are_allowed():
    server = open_server("0.0.0.0", 0, allow=("proxy.example",))
    try:
        assert ask(server, Host="192.0.2.1:{port}", Origin="http://192.0.2.1:{port}") == 200
        assert ask(server, Host="proxy.example", Origin="https://proxy.example") == 200
        assert ask(server, upgrade=True, Origin="https://proxy.example") == 101
        assert ask(server, Host="evil.example") == 403
        assert ask(server, upgrade=True, Origin="http://evil.example") == 403
    finally:
        close_server(server)


def test_no_tunnel_is_opened_whoever_asks(server):
    assert server.request_share_url() is None


def test_where_nobody_can_listen_is_told_and_not_passed_over(server):
    used = server.get_port()
    for host, port, error in (
        ("127.0.0.1", used, OSError), ("192.0.2.1", 0, OSError),
        ("no such.host.invalid", 0, OSError), ("127.0.0.1", -1, ValueError),
        ("127.0.0.1", 65536, ValueError),
    ):  # fmt: skip
        with pytest.raises(error, match=str(used) if port == used else "--port|--host|192"):
            open_server(host, port)
