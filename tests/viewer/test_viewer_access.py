"""Access to a viewer: only its own page with its token, and only messages that such a page sends."""

from __future__ import annotations

import http.client
import math
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch

pytest.importorskip("viser", reason="the package viser is not installed")

import msgspec
import numpy as np
from websockets.asyncio import server as websocket_server
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidStatus

from neuprim.config.command_settings import ViewerSettings
from neuprim.core.channels import Channels
from neuprim.core.errors import BackendUnavailable, ConfigError
from neuprim.core.model.cosine import CosineDensity
from neuprim.core.render import RenderSettings
from neuprim.tasks.static import TASK, SphericalHarmonics
from neuprim.viewer.controls import SessionManager
from neuprim.viewer.server import TokenAuth, ViewerServer, is_loopback, refuse_message
from neuprim.viewer.session import RenderQueue
from neuprim.viewer.viewer_scene import ViewerScene
from tests.page_models import random_model
from tests.viewer_client import fetch, visit

NAN, INF = math.nan, math.inf
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": (1, 0, 0, 0), "position": (0, -4.0, 1), "fov": 0.8, "near": 0.01,
    "far": 1000, "image_height": 48,
    "image_width": 64, "look_at": (0, 0, 0), "up_direction": (0, 0, 1),
}  # fmt: skip
CLICK = {
    "type": "ScenePointerMessage",
    "event_type": "click",
    "ray_origin": (0, 0, 0),
    "ray_direction": (0, 1, 0),
    "screen_pos": [(0.5, 0.5)],
}


@pytest.fixture(scope="module")
def page() -> Iterator[ViewerServer]:
    made = ViewerServer(ViewerSettings(port=0), "a run")
    yield made
    made.close()


def without_token(page: ViewerServer) -> str:
    return page.address.partition("?")[0]


def test_the_page_is_for_those_with_the_token(page: ViewerServer) -> None:
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


def test_a_stranger_gets_no_connection_and_nothing_is_sent(page: ViewerServer) -> None:
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
    assert websocket_server.serve.__name__ == "serve" and isinstance(websocket_server.serve, type), "viser is unchanged"


def test_odd_requests_are_refused(page: ViewerServer) -> None:
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
    page: ViewerServer, monkeypatch: pytest.MonkeyPatch
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
    def nothing(self: TokenAuth, *args: Any) -> Iterator[None]:
        yield

    monkeypatch.setattr(TokenAuth, "guard_server", nothing)
    with pytest.raises(BackendUnavailable, match="did not start with access control"):
        ViewerServer(ViewerSettings(port=0), "a run")


def test_ports_and_hosts_that_are_not_to_be_had(page: ViewerServer) -> None:
    port = page.viser.get_port()
    with pytest.raises(ConfigError, match=f"port {port}.*expected an address of this machine and a free port"):
        ViewerServer(ViewerSettings(port=port), "another")
    with pytest.raises(ConfigError, match=r"host\.invalid"):
        ViewerServer(ViewerSettings("host.invalid", 0), "another")


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
    gate = TokenAuth(listens)
    for host in [*good, *bad]:
        found = gate.refuse_request(f"/?token={gate.token}", Headers({"Host": host, "Origin": f"http://{host}"}))
        assert (found is None) is (host in good), (host, found)
        assert found is None or found.startswith("this server's name is localhost or 127.0.0.1 or [::1]")


def test_what_counts_as_this_machine_alone() -> None:
    assert all(map(is_loopback, ("127.0.0.1", "::1", "localhost", "127.8.1.2")))
    assert not any(map(is_loopback, ("0.0.0.0", "10.0.0.3", "a.b")))


def reason(message: Any, handle: Any = None) -> str | None:
    return refuse_message(
        message if isinstance(message, bytes | str) else msgspec.msgpack.encode(message), lambda uuid: handle
    )


def test_what_a_page_sends_passes() -> None:
    drag = {"name": "/light", "owner": "1"}
    moved = {"type": "TransformControlsUpdateMessage", "wxyz": (1, 0, 0, 0), "position": (1, 2, 3.5), **drag}
    for message in (
        CAMERA,
        CLICK,
        {**CLICK, "modifier": None},
        moved,
        {"type": "TransformControlsDragStartMessage", **drag},
    ):
        assert reason(message) is None


CHANGES: list[dict[str, Any]] = [
    {"fov": NAN}, {"fov": 1e9}, {"fov": 0}, {"fov": -1}, {"image_width": 10**7}, {"image_height": -1},
    {"image_width": NAN}, {"image_height": 0.5}, {"position": (NAN, 0, 0)}, {"position": (0, -INF, 0)},
    {"position": (0, 0)},
    {"position": [0] * 10_000},
    {"position": (1e300, 0, 0)}, {"wxyz": (0, 0, 0, 0)}, {"wxyz": (1, 1, 1, 1)}, {"look_at": None}, {"near": "x"},
    {"far": True}, {"removed": True}, {"type": "ShareUrlRequest"}, {"type": "FileTransferStartUpload"}, {"type": ["a"]},
    {"type": None},
]  # fmt: skip
UPDATE = {"type": "GuiUpdateMessage", "uuid": "a"}


@pytest.mark.parametrize(
    "message",
    [
        *({**CAMERA, **change} for change in CHANGES),
        b"", b"\x00", b"\xc1", b"\x91" * 60_000, b"\xdf\xff\xff\xff\xff", b"\xdd\xff\xff\xff\xff", "text", [1], None,
        {}, {"type": "X"}, {**CLICK, "event_type": "rect-select"}, {**CLICK, "ray_direction": None},
        {**CLICK, "screen_pos": [(0, 0)] * 99},
        UPDATE, {**UPDATE, "uuid": 1, "updates": {"value": 1}}, {**UPDATE, "updates": {"update_cb": []}},
        {**UPDATE, "updates": {"value": 1, "removed": True}}, {**UPDATE, "uuid": "none there", "updates": {"value": 1}},
        {"type": "CommandTriggerMessage", "uuid": "a"}, {"type": "GetRenderResponseMessage", "payload": b""},
    ],
    ids=range(44),
)  # fmt: skip
def test_other_messages_do_not(message: Any) -> None:
    found = reason(message)
    assert found is not None and "\n" not in found and len(found) < 300


CONTROLS: list[tuple[Callable[[Any], Any], list[Any], list[Any]]] = [
    (lambda g: g.add_dropdown("film", ["webp", "mp4"]), ["mp4"], ["gif", "../../../x", "", 0, None, ["mp4"], {"a": 1}]),
    (lambda g: g.add_button_group("write", ["cameras", "film"]), ["film"], ["delete", True, NAN]),
    (lambda g: g.add_slider("pixels", 128, 2048, 32, 960), [128, 2048, 160],
        [20_000, 0, -128, 200.5, NAN, INF, "200", True, [1] * 9, 1e30]),
    (lambda g: g.add_slider("time", 0.0, 1.0, 0.001, 0.5), [0, 1, 0.25, 1.0000001],
        [1.1, -0.1, NAN, -INF, None, "0.5", 2**63]),
    (lambda g: g.add_number("seconds", 4.0, min=0.1, max=600.0, step=0.1), [1, 0.1], [0, -1, 1e9, NAN, "1"]),
    (lambda g: g.add_number("samples", 1, step=1), [3], [1.5, NAN, INF, "2", -INF, 10**18, False]),
    (lambda g: g.add_checkbox("play", False), [True, False], [1, 0, "yes", None, []]),
    (lambda g: g.add_text("words", ""), ["", "a=b\n"], ["x" * 5000, 5, None, ["a"]]),
    (lambda g: g.add_text("status", "", disabled=True), [], ["hello"]),
]  # fmt: skip


@pytest.mark.parametrize("number", range(len(CONTROLS)))
def test_a_control_takes_what_it_was_made_for(page: ViewerServer, number: int) -> None:
    make, good, bad = CONTROLS[number]
    handle = make(page.viser.gui)
    for value in good:
        assert (
            reason({"type": "GuiUpdateMessage", "uuid": handle._impl.uuid, "updates": {"value": value}}, handle) is None
        ), value
    for value in bad:
        found = reason({"type": "GuiUpdateMessage", "uuid": handle._impl.uuid, "updates": {"value": value}}, handle)
        assert found is not None and found.startswith(f"{handle.label}: ") and len(found) < 200, value


@pytest.fixture(scope="module")
def visited() -> Iterator[tuple[SessionManager, str]]:
    """The page of a small model."""
    model = random_model(CosineDensity(2, edge=2), SphericalHarmonics(1), count=30)
    channels = Channels(("R", "G", "B"), "srgb", None, "static")
    own = (TASK, lambda: model, channels, RenderSettings(backend="reference"), torch.ones(3), (0.0, 0.0, 1.0))
    server, queue, end = ViewerServer(ViewerSettings(port=0), "it"), RenderQueue(), threading.Event()
    manager = SessionManager(server, ViewerScene("it", *own, np.zeros(3)), queue)
    thread = threading.Thread(target=lambda: [queue.work(0.05) for _ in iter(end.is_set, True)])
    thread.start()
    yield manager, server.address
    end.set()
    thread.join(20)
    server.close()


def test_a_hostile_page_changes_nothing_and_is_told(visited: tuple[SessionManager, str], capfd: Any) -> None:
    manager, address = visited
    with visit(address) as visitor:
        visitor.stand()
        visitor.hear(20, lambda messages: len(visitor.pictures()) > 1 and "its parameters" in str(messages))
        (session,) = manager.sessions.values()
        before = (session.longest, session.quantity, session.settings)

        def expect(text: str) -> None:
            visitor.hear(10, lambda messages: any(text in str(m) for m in messages[len(messages) - 50 :]))
            assert any(text in str(m) for m in visitor.messages), text

        for label, value, said in (
            ("sort", "../../outside", "sort: is not one of the"),
            ("pixels", 20_000, "pixels: expected a whole number from 128 to 2048"),
            ("alpha_min", NAN, "alpha_min: expected a"),
            ("show", "no such thing", "show: is not one of"),
            ("status", "hello", "status: cannot be set"),
        ):
            visitor.set(label, value)
            expect(f"refused: {said}")
        visitor.say("GuiUpdateMessage", uuid=visitor.control("pixels"), updates={"update_cb": []})
        visitor.say("ViewerCameraMessage", **{**CAMERA, "fov": NAN, "image_width": 10**7})
        visitor.socket.send("text")
        expect("a message in text")
        assert before == (session.longest, session.quantity, session.settings)
        assert session.viewpoint().camera.width <= 960
        visitor.set("show", "alpha")  # the page still works
        visitor.hear(10, lambda messages: session.quantity == "alpha")
        assert session.quantity == "alpha"
    assert "Traceback" not in "".join(capfd.readouterr())


def test_a_message_of_many_bytes_ends_its_connection(visited: tuple[SessionManager, str]) -> None:
    _, address = visited
    with visit(address) as visitor:
        visitor.stand()
        with pytest.raises(ConnectionClosed, match="1009"):
            visitor.say("GuiUpdateMessage", uuid="a", updates={"value": [0] * 10**7})
            visitor.hear(10)
    with visit(address) as visitor:
        assert visitor.hear(5, lambda messages: len(messages) > 0)
