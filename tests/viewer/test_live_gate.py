"""Who may talk to a viewer: only somebody with its token, from its own page."""

from __future__ import annotations

import dataclasses
import http.client
import importlib
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

pytest.importorskip("viser", reason="the package viser is not installed")

from websockets.asyncio import server as websocket_server
from websockets.datastructures import Headers
from websockets.exceptions import InvalidStatus

from neuprim.config.viewer import ViewerSettings
from neuprim.core.errors import BackendUnavailable, ConfigError
from neuprim.viewer.gate import Gate
from neuprim.viewer.incoming import known
from neuprim.viewer.server import PageServer, is_loopback
from tests.viewer_client import fetch, visit


@pytest.fixture(scope="module")
def page() -> Iterator[PageServer]:
    made = PageServer(ViewerSettings(port=0), "a run")
    yield made
    made.close()


def without_token(page: PageServer) -> str:
    return page.address.partition("?")[0]


def test_the_page_is_for_those_with_the_token(page: PageServer) -> None:
    status, headers, body = fetch(page.address)
    assert status == 200 and b"<html" in body
    assert headers["Set-Cookie"].endswith("; Path=/; HttpOnly; SameSite=Strict")
    assert "connect-src 'self'" in headers["Content-Security-Policy"] and headers["Cache-Control"] == "no-store"
    cookie = headers["Set-Cookie"].partition(";")[0]
    assert fetch(without_token(page), Cookie=cookie)[0] == 200
    for address, more in (
        (without_token(page), {}),
        (without_token(page) + "?token=", {}),
        (page.address[:-1] + ("A" if page.address[-1] != "A" else "B"), {}),
        (without_token(page), {"Cookie": "neuprim-1=" + cookie.partition("=")[2]}),
        (page.address, {"Origin": "http://evil.example"}),
        (page.address, {"Origin": "null"}),
    ):
        status, headers, body = fetch(address, **more)
        assert status == 403 and b"<html" not in body and headers["Set-Cookie"] is None, address


def test_a_stranger_gets_no_connection_and_nothing_is_sent(page: PageServer) -> None:
    come: list[Any] = []
    page.viser._websock_server.on_client_connect(come.append)
    token = page.address.partition("token=")[2]
    port = page.viser.get_port()
    for headers in (
        {"Cookie": ""},
        {"Cookie": f"neuprim-{port}={token[:-1]}"},
        {
            "Origin": "http://evil.example"
        },  # a page that the user has open elsewhere, even if the browser sent the cookie
        {"Origin": f"http://localhost:{port + 1}"},  # another server on this machine
        {
            "Host": f"evil.example:{port}",
            "Origin": f"http://evil.example:{port}",
            "Cookie": "",
        },  # a name that was bent to this machine
    ):
        with pytest.raises(InvalidStatus, match="403"), visit(page.address, **headers):
            pass
    assert come == []
    with visit(page.address) as visitor:
        assert visitor.hear(5.0, lambda messages: len(messages) > 0)
    assert len(come) == 1


def test_odd_requests_are_refused(page: PageServer) -> None:
    host, port = "127.0.0.1", page.viser.get_port()
    token = page.address.partition("?")[2]
    for hosts in ([], ["a b"], ["x;y"], ["one:1", "two:2"]):
        connection = http.client.HTTPConnection(host, port, timeout=10)
        connection.putrequest("GET", f"/?{token}", skip_host=True)
        for name in hosts:
            connection.putheader("Host", name)
        connection.endheaders()
        assert connection.getresponse().status in (400, 403)
        connection.close()
    assert fetch(page.address.replace("/?", "/../../etc/passwd?"))[0] == 404


def test_the_page_cannot_be_passed_on_through_a_server_elsewhere(
    page: PageServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    monkeypatch.setattr("viser._viser.ViserTunnel", lambda *args: asked.append("tunnel"))
    with visit(page.address) as visitor:
        visitor.stand()
        visitor.say("ShareUrlRequest")
        visitor.hear(1.0)
    assert asked == []


def test_without_its_gate_a_server_does_not_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another version of viser may start otherwise; then there is no viewer rather than an open one."""

    @contextmanager
    def nothing(self: Gate, *args: Any) -> Iterator[None]:
        yield

    monkeypatch.setattr(Gate, "before_viser", nothing)
    with pytest.raises(BackendUnavailable, match="did not start behind the check"):
        PageServer(ViewerSettings(port=0), "a run")


def test_pages_of_another_viser_are_not_served(monkeypatch: pytest.MonkeyPatch) -> None:
    """A message with one more field would be refused each time it comes; that is said at once."""
    messages = importlib.import_module("viser._messages")
    longer = dataclasses.make_dataclass("ViewerCameraMessage", [("wxyz", tuple), ("zoom", float)])
    monkeypatch.setattr(messages, "ViewerCameraMessage", longer)
    assert not known(messages)
    monkeypatch.undo()
    assert known(messages)


def test_viser_is_left_as_it_was(page: PageServer) -> None:
    assert websocket_server.serve.__name__ == "serve" and isinstance(websocket_server.serve, type)


def test_a_token_is_never_that_of_another() -> None:
    gates = [Gate() for _ in range(3)]
    assert len({gate.token for gate in gates}) == 3 and all(len(gate.token) == 43 for gate in gates)
    headers = Headers({"Host": "localhost:80", "Cookie": f"neuprim-80={gates[0].token}"})
    assert gates[0].refusal("/", headers) is None and gates[1].refusal("/", headers) is not None
    assert gates[0].address("::1", 8) == f"http://[::1]:8/?token={gates[0].token}"


def test_ports_and_hosts_that_are_not_to_be_had(page: PageServer) -> None:
    port = page.viser.get_port()
    with pytest.raises(ConfigError, match=f"port {port}.*expected an address of this machine and a free port"):
        PageServer(ViewerSettings(port=port), "another")
    with pytest.raises(ConfigError, match=r"host\.invalid"):
        PageServer(ViewerSettings("host.invalid", 0), "another")


@pytest.mark.parametrize(
    ("listens", "good", "bad"),
    [
        (
            "127.0.0.1",
            ["localhost", "LOCALHOST:80", "127.0.0.1:9", "[::1]:9"],
            ["evil.example", "localhost.evil.example:9", "10.0.0.3", "127.0.0.2"],
        ),
        (
            "10.0.0.3",
            ["10.0.0.3:8080", "localhost:8080"],
            ["10.0.0.4:8080", "evil.example:8080", "10.0.0.3.evil.example"],
        ),
        ("fe80::1", ["[fe80::1]:8080"], ["[fe80::2]:8080", "evil.example"]),
        ("render.lan", ["render.lan:8080", "Render.LAN"], ["lan:8080", "10.0.0.3"]),
        (
            "0.0.0.0",
            ["10.0.0.3:8080", "[fe80::1]", "localhost", socket.gethostname()],
            ["evil.example:8080", "localhost."],
        ),
        ("::", ["10.0.0.3:8080", "[::1]:8"], ["evil.example:8080"]),
    ],
)
def test_a_server_answers_to_its_own_names_alone(listens: str, good: list[str], bad: list[str]) -> None:
    """A name that its owner bends to this machine would make his page one of the same origin, token or not."""
    gate = Gate(listens)
    for host in [*good, *bad]:
        found = gate.refusal(f"/?token={gate.token}", Headers({"Host": host, "Origin": f"http://{host}"}))
        assert (found is None) is (host in good), (host, found)
        assert found is None or found.startswith("this server's name is localhost or 127.0.0.1 or [::1]")


@pytest.mark.parametrize(
    ("host", "own"),
    [
        ("127.0.0.1", True),
        ("::1", True),
        ("localhost", True),
        ("127.8.1.2", True),
        ("0.0.0.0", False),
        ("10.0.0.3", False),
        ("a.b", False),
    ],
)
def test_what_counts_as_this_machine_alone(host: str, own: bool) -> None:
    assert is_loopback(host) is own
