"""Visitors of a viewer without a browser: an HTTP request, and a WebSocket that speaks as much of viser's language as a
page must."""

from __future__ import annotations

import io
import time
from contextlib import contextmanager
from typing import Any
from urllib.parse import parse_qs, urlsplit
from urllib.request import Request, urlopen

import numpy as np
from PIL import Image

__all__ = ["Visitor", "fetch", "visit"]


def fetch(address: str, **headers: str) -> tuple[int, Any, bytes]:
    """Status, headers and body of a GET."""
    from urllib.error import HTTPError

    try:
        with urlopen(Request(address, headers=headers), timeout=20) as answer:
            return answer.status, answer.headers, answer.read()
    except HTTPError as error:
        return error.code, error.headers, error.read()


class Visitor:
    """An open WebSocket; ``messages`` are all that came, as dictionaries with arrays and bytes put back."""

    def __init__(self, socket: Any) -> None:
        self.socket, self.messages = socket, list[dict[str, Any]]()

    def say(self, kind: str, **fields: Any) -> None:
        import msgspec

        self.socket.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def stand(self, position: tuple[float, float, float] = (0.0, -4.0, 1.0), size: tuple[int, int] = (64, 48)) -> None:
        """A camera that looks at the origin, as a page reports it."""
        self.say(
            "ViewerCameraMessage", wxyz=(0.7071, -0.7071, 0.0, 0.0), position=position, fov=0.8, near=0.01, far=100.0,
            image_height=size[1],
            image_width=size[0], look_at=(0.0, 0.0, 0.0), up_direction=(0.0, 0.0, 1.0),
        )  # fmt: skip

    def hear(self, seconds: float, enough: Any = lambda messages: False) -> list[dict[str, Any]]:
        """Everything so far, after so many seconds or when it is enough."""
        end = time.monotonic() + seconds
        while time.monotonic() < end and not enough(self.messages):
            try:
                self.messages += _decoded(self.socket.recv(timeout=max(min(0.2, end - time.monotonic()), 0.01)))
            except TimeoutError:
                pass
        return self.messages

    def pictures(self) -> list[np.ndarray]:
        """(H, W, 3) uint8 each, of the background."""
        found = [m["rgb_data"] for m in self.messages if m["type"] == "BackgroundImageMessage"]
        return [np.asarray(Image.open(io.BytesIO(bytes(data))).convert("RGB")) for data in found if data is not None]

    def control(self, label: str) -> str:
        """The number of the control of that name."""
        return next(
            m["uuid"] for m in self.messages if m["type"].startswith("Gui") and m.get("props", {}).get("label") == label
        )

    def set(self, label: str, value: Any) -> None:
        """What a page says when its user has moved a control."""
        self.say("GuiUpdateMessage", uuid=self.control(label), updates={"value": value})


@contextmanager
def visit(address: str, **headers: str) -> Any:
    """A visitor at an address with a token; ``headers`` over those that a page would send."""
    import viser
    from websockets.sync.client import connect

    parts = urlsplit(address)
    token = parse_qs(parts.query).get("token", [""])[0]
    own = {"Cookie": f"neuprim-{parts.port}={token}", "Origin": f"http://{parts.netloc}", **headers}
    with connect(
        f"ws://{parts.netloc}/",
        subprotocols=[f"viser-v{viser.__version__}"],
        additional_headers=own,
        max_size=None,
        compression=None,
    ) as socket:  # type: ignore[list-item]
        yield Visitor(socket)


def _decoded(data: Any) -> list[dict[str, Any]]:
    """The messages of one frame: sizes, zstd-compressed msgpack, and the binary arrays after it, each on a multiple of
    eight bytes."""
    import msgspec
    import zstandard

    size = int.from_bytes(data[8:16], "little")
    plain = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(data[16 : 16 + size]))
    buffers, at = [], 16 + size
    for length in plain["binaryBufferLengths"]:
        at += -at % 8
        buffers.append(data[at : at + length])
        at += length

    def restored(value: Any) -> Any:
        if isinstance(value, dict):
            return (
                buffers[value["__binary_index"]]
                if "__binary_index" in value
                else {k: restored(v) for k, v in value.items()}
            )
        return [restored(v) for v in value] if isinstance(value, list | tuple) else value

    return [restored(message) for message in plain["messages"]]
