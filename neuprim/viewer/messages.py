"""Checks of the messages that pages send; viser itself checks nothing.

A message passes only if the page's own code sends such messages, and a control's value only if the control, as it was
created, can take it. Every message goes through :class:`CheckedConnection`.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import operator
from collections.abc import Callable
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta
from websockets.asyncio.server import ServerConnection

from neuprim.core.validation import Range

__all__ = ["MAX_MESSAGE_BYTES", "CheckedConnection", "is_known_protocol", "refuse_message", "refuse_value"]

MAX_MESSAGE_BYTES = 2**16  # a page sends some hundred

_MAX_TEXT = 4096

_Finite = Annotated[float, Meta(ge=-1e12, le=1e12)]  # NaN is refused, too
_Vector = tuple[_Finite, _Finite, _Finite]
_Pixels = Annotated[int, Meta(ge=0, le=2**14)]
_Name = Annotated[str, Meta(max_length=1024)]


class _Message(msgspec.Struct, tag_field="type", forbid_unknown_fields=True):
    """The messages that the page needs. viser knows more: uploads, shares, commands."""


class ViewerCameraMessage(_Message):
    wxyz: tuple[_Finite, _Finite, _Finite, _Finite]
    position: _Vector
    fov: Annotated[float, Meta(ge=1e-3, le=3.14)]
    near: _Finite
    far: _Finite
    image_height: _Pixels
    image_width: _Pixels
    look_at: _Vector
    up_direction: _Vector


class ScenePointerMessage(_Message):
    event_type: Literal["click"]
    ray_origin: _Vector
    ray_direction: _Vector
    screen_pos: Annotated[list[tuple[_Finite, _Finite]], Meta(max_length=1)]
    modifier: _Name | None = None


class TransformControlsUpdateMessage(_Message):
    name: _Name
    wxyz: tuple[_Finite, _Finite, _Finite, _Finite]
    position: _Vector
    owner: _Name = ""


class TransformControlsDragStartMessage(_Message):
    name: _Name
    owner: _Name = ""


class TransformControlsDragEndMessage(_Message):
    name: _Name
    owner: _Name = ""


class _Updates(msgspec.Struct, forbid_unknown_fields=True):
    value: Any


class GuiUpdateMessage(_Message):
    uuid: _Name
    updates: _Updates


_KINDS = (
    ViewerCameraMessage,
    ScenePointerMessage,
    TransformControlsUpdateMessage,
    TransformControlsDragStartMessage,
    TransformControlsDragEndMessage,
    GuiUpdateMessage,
)
_DECODER = msgspec.msgpack.Decoder(functools.reduce(operator.or_, _KINDS))  # type: ignore[arg-type]


def is_known_protocol(messages: Any) -> bool:
    """Whether viser's messages module defines these messages with these fields; other versions may not."""
    kinds = ((kind, getattr(messages, kind.__name__, None)) for kind in _KINDS)
    return all(
        own is not None and {f.name for f in dataclasses.fields(own)} == set(kind.__struct_fields__)
        for kind, own in kinds
    )


class CheckedConnection(ServerConnection):
    """A connection that drops every message for which ``check_message`` (of its bytes) returns a reason.

    ``on_refusal`` is called with the connection and the reason.
    """

    def __init__(
        self,
        *args: Any,
        check_message: Callable[[Any], str | None],
        on_refusal: Callable[[ServerConnection, str], None],
        **options: Any,
    ) -> None:
        super().__init__(*args, **options)
        self._check, self._on_refusal = check_message, on_refusal

    async def recv(self, decode: bool | None = None) -> Any:
        while (reason := self._check(message := await super().recv(decode))) is not None:
            self._on_refusal(self, reason)
        return message


def refuse_message(message: bytes | str, find_control: Callable[[str], Any]) -> str | None:
    """Return why a message is dropped, None if it passes.

    Args:
        find_control: viser's handle of a control by its id; None if there is none.
    """
    if not isinstance(message, bytes):
        return "a message in text; expected msgpack"
    try:
        decoded = _DECODER.decode(message)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        return f"a message that this page does not send: {' '.join(str(error).split())[:200]}"
    if (
        isinstance(decoded, ViewerCameraMessage | TransformControlsUpdateMessage)
        and not 0.99 < math.hypot(*decoded.wxyz) < 1.01
    ):
        return "a message that this page does not send: expected a unit quaternion - at `$.wxyz`"
    if not isinstance(decoded, GuiUpdateMessage):
        return None
    handle = find_control(decoded.uuid)
    if handle is None:
        return "a control that is not there"
    reason = refuse_value(handle, decoded.updates.value)
    return None if reason is None else f"{getattr(handle, 'label', 'a control')}: {reason}"


def refuse_value(handle: Any, value: Any) -> str | None:
    """Return why a control cannot take a value, by the type, choices and bounds that it was created with."""
    now, props = handle._impl.value, handle._impl.props
    options, low, high = (getattr(props, name, None) for name in ("options", "min", "max"))
    if getattr(props, "disabled", False):
        return "cannot be set"
    if options is not None:
        return None if isinstance(value, str) and value in options else f"is not one of the {len(options)} choices"
    if isinstance(now, bool):
        return None if isinstance(value, bool) else "expected true or false"
    if isinstance(now, str):
        if not isinstance(value, str) or len(value) > _MAX_TEXT:
            return f"expected a text of at most {_MAX_TEXT} characters"
        return None
    if isinstance(now, int | float):
        return _refuse_number(now, value, low, high, getattr(props, "step", None))
    return "takes no value"


def _refuse_number(
    now: float, value: Any, low: float | None, high: float | None, step: float | None = None
) -> str | None:
    kind = "a whole number" if isinstance(now, int) else "a number"
    slack = step / 2 if isinstance(now, float) and step is not None else 0.0  # a page rounds to the digits of its steps
    bounds = Range(None if low is None else low - slack, None if high is None else high + slack)
    fits = isinstance(value, int) or (
        isinstance(value, float) and math.isfinite(value) and (isinstance(now, float) or value.is_integer())
    )
    if fits and not isinstance(value, bool) and abs(value) <= 1e15 and bounds.accepts(value):
        return None
    return f"expected {Range(low, high).words(kind)}"
