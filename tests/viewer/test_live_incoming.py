"""Messages that no page sends, and values that a control was not made for: dropped, with one line, before anything acts
on them."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("viser", reason="the package viser is not installed")

import msgspec

from neuprim.config.viewer import ViewerSettings
from neuprim.core.channels import Channels
from neuprim.core.model.densities.cosine import CosineDensity
from neuprim.core.render import RenderSettings
from neuprim.tasks.static import TASK
from neuprim.tasks.static.fields import SphericalHarmonics
from neuprim.viewer.desk import Desk
from neuprim.viewer.incoming import refusal
from neuprim.viewer.page import Page
from neuprim.viewer.server import PageServer
from neuprim.viewer.subject import Subject
from tests.page_models import random_model
from tests.viewer_client import Visitor, visit

NAN, INF = math.nan, math.inf
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": (1, 0, 0, 0), "position": (0, -4.0, 1), "fov": 0.8, "near": 0.01, "far": 1000, "image_height": 48,
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
def server() -> Iterator[PageServer]:
    made = PageServer(ViewerSettings(port=0), "a run")
    yield made
    made.close()


def reason(message: Any, handle: Any = None) -> str | None:
    return refusal(
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


@pytest.mark.parametrize(
    "change",
    [
        {"fov": NAN}, {"fov": 1e9}, {"fov": 0}, {"fov": -1}, {"image_width": 10**7}, {"image_height": -1}, {"image_width": NAN},
        {"image_height": 0.5}, {"position": (NAN, 0, 0)}, {"position": (0, -INF, 0)}, {"position": (0, 0)}, {"position": [0] * 10_000},
        {"position": (1e300, 0, 0)}, {"wxyz": (0, 0, 0, 0)}, {"wxyz": (1, 1, 1, 1)}, {"look_at": None}, {"near": "x"}, {"far": True},
        {"removed": True}, {"type": "ShareUrlRequest"}, {"type": "FileTransferStartUpload"}, {"type": ["a"]}, {"type": None},
    ],
)  # fmt: skip
def test_other_cameras_do_not(change: dict[str, Any]) -> None:
    found = reason({**CAMERA, **change})
    assert found is not None and "\n" not in found and len(found) < 300


@pytest.mark.parametrize(
    "message",
    [
        b"", b"\x00", b"\xc1", b"\x91" * 60_000, b"\xdf\xff\xff\xff\xff", b"\xdd\xff\xff\xff\xff", "text", [1], None, {}, {"type": "X"},
        {**CLICK, "event_type": "rect-select"}, {**CLICK, "ray_direction": None}, {**CLICK, "screen_pos": [(0, 0)] * 99},
        {"type": "GuiUpdateMessage", "uuid": "a"}, {"type": "GuiUpdateMessage", "uuid": 1, "updates": {"value": 1}},
        {"type": "GuiUpdateMessage", "uuid": "a", "updates": {"update_cb": []}},
        {"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": 1, "removed": True}},
        {"type": "GuiUpdateMessage", "uuid": "none there", "updates": {"value": 1}},
        {"type": "CommandTriggerMessage", "uuid": "a"}, {"type": "GetRenderResponseMessage", "payload": b""},
    ],
)  # fmt: skip
def test_other_messages_do_not(message: Any) -> None:
    found = reason(message)
    assert found is not None and "\n" not in found and len(found) < 300


CONTROLS: list[tuple[Callable[[Any], Any], list[Any], list[Any]]] = [
    (lambda g: g.add_dropdown("film", ["webp", "mp4"]), ["mp4"], ["gif", "../../../x", "", 0, None, ["mp4"], {"a": 1}]),
    (lambda g: g.add_button_group("write", ["cameras", "film"]), ["film"], ["delete", True, NAN]),
    (lambda g: g.add_slider("pixels", 128, 2048, 32, 960), [128, 2048, 160], [20_000, 0, -128, 200.5, NAN, INF, "200", True, [1] * 9, 1e30]),
    (lambda g: g.add_slider("time", 0.0, 1.0, 0.001, 0.5), [0, 1, 0.25, 1.0000001], [1.1, -0.1, NAN, -INF, None, "0.5", 2**63]),
    (lambda g: g.add_number("seconds", 4.0, min=0.1, max=600.0, step=0.1), [1, 0.1], [0, -1, 1e9, NAN, "1"]),
    (lambda g: g.add_number("samples", 1, step=1), [3], [1.5, NAN, INF, "2", -INF, 10**18, False]),
    (lambda g: g.add_vector2("size", (640, 360), min=(16, 16), max=(8192, 8192)), [[16, 8192]], [[8, 8], [1e5, 9], [NAN, 99], [99], [99] * 10**6, 99]),
    (lambda g: g.add_checkbox("play", False), [True, False], [1, 0, "yes", None, []]),
    (lambda g: g.add_text("words", ""), ["", "a=b\n"], ["x" * 5000, 5, None, ["a"]]),
    (lambda g: g.add_text("status", "", disabled=True), [], ["hello"]),
]  # fmt: skip


@pytest.mark.parametrize("number", range(len(CONTROLS)))
def test_a_control_takes_what_it_was_made_for(server: PageServer, number: int) -> None:
    make, good, bad = CONTROLS[number]
    handle = make(server.viser.gui)
    for value in good:
        assert (
            reason({"type": "GuiUpdateMessage", "uuid": handle._impl.uuid, "updates": {"value": value}}, handle) is None
        ), value
    for value in bad:
        found = reason({"type": "GuiUpdateMessage", "uuid": handle._impl.uuid, "updates": {"value": value}}, handle)
        assert found is not None and found.startswith(f"{handle.label}: ") and len(found) < 200, value


@pytest.fixture
def visited(tmp_path: Path) -> Iterator[tuple[Page, str]]:
    """A page of a small model, whose paths and films go into ``tmp_path/run``."""
    model = random_model(CosineDensity(2, edge=2), SphericalHarmonics(1), count=30)
    channels = Channels(("R", "G", "B"), "srgb", None, "static")
    own = (TASK, lambda: model, channels, RenderSettings(backend="reference"), torch.ones(3), (0.0, 0.0, 1.0))
    server, desk, end = PageServer(ViewerSettings(port=0), "it"), Desk(), threading.Event()
    (tmp_path / "run").mkdir()
    page = Page(server, Subject("it", *own, Subject.middle_of(model)), desk, tmp_path / "run")
    thread = threading.Thread(target=lambda: [desk.work(0.05) for _ in iter(end.is_set, True)])
    thread.start()
    yield page, server.address
    end.set()
    thread.join(20)
    server.close()


def test_a_hostile_page_changes_nothing_and_is_told(visited: tuple[Page, str], tmp_path: Path, capfd: Any) -> None:
    page, address = visited
    with visit(address) as visitor:
        visitor.stand()
        visitor.hear(
            20,
            lambda messages: (
                len(visitor.pictures()) > 1 and any(m.get("props", {}).get("label") == "film" for m in messages)
            ),
        )
        (session,) = page.sessions.values()
        before = (session.longest, session.shows, session.settings)

        def told(text: str) -> None:
            visitor.hear(10, lambda messages: any(text in str(m) for m in messages[len(messages) - 50 :]))
            assert any(text in str(m) for m in visitor.messages), text

        for label, value, said in (
            ("film", "../../outside", "film: is not one of the 4 choices"),
            ("pixels", 20_000, "pixels: expected a whole number from 128 to 2048"),
            ("size", [8, NAN], "size: expected a"),
            ("show", "no such thing", "show: is not one of"),
            ("status", "hello", "status: cannot be set"),
        ):
            visitor.set(label, value)
            told(f"refused: {said}")
        visitor.say("GuiUpdateMessage", uuid=visitor.control("pixels"), updates={"update_cb": []})
        visitor.say("ViewerCameraMessage", **{**CAMERA, "fov": NAN, "image_width": 10**7})
        visitor.socket.send("text")
        told("a message in text")
        visitor.set("keys", "add")
        visitor.set("write", "cameras")
        told("path.json")  # the page still works
        assert before == (session.longest, session.shows, session.settings) and session.look().camera.width <= 960
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["path.json"]
    assert "Traceback" not in "".join(capfd.readouterr())


def test_a_message_of_many_bytes_ends_its_connection(visited: tuple[Page, str]) -> None:
    from websockets.exceptions import ConnectionClosed

    _, address = visited
    with visit(address) as visitor:
        visitor.stand()
        with pytest.raises(ConnectionClosed, match="1009"):
            visitor.say("GuiUpdateMessage", uuid="a", updates={"value": [0] * 10**7})
            visitor.hear(10)
    with visit(address) as visitor:
        assert isinstance(visitor, Visitor) and visitor.hear(5, lambda messages: len(messages) > 0)
