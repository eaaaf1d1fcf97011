"""Messages of pages, checked before anything acts on them.

Rule: a message is handed on only if it is one that the page's own code sends, and the value of a control only if the
control, as it was made, takes it. Every message of every page passes :class:`CheckedConnection`; viser itself checks
nothing.
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

from neuprim.core.checked import Range

__all__ = ["LARGEST", "CheckedConnection", "known", "refusal", "value_refusal"]

LARGEST = 2**16
"""Bytes of a message; a page sends some hundred."""

_LONGEST = 4096
"""Characters of a text control."""

_Finite = Annotated[float, Meta(ge=-1e12, le=1e12)]  # NaN is refused, too
_Vector = tuple[_Finite, _Finite, _Finite]
_Pixels = Annotated[int, Meta(ge=0, le=2**14)]
_Name = Annotated[str, Meta(max_length=1024)]


class _Message(msgspec.Struct, tag_field="type", forbid_unknown_fields=True):
    """What the page's code sends, of all that viser takes: no uploads, shares, commands or requested pictures."""


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


def known(messages: Any) -> bool:
    """Whether the module of viser's messages has these kinds with these fields; another version of viser may not."""
    kinds = ((kind, getattr(messages, kind.__name__, None)) for kind in _KINDS)
    return all(
        own is not None and {f.name for f in dataclasses.fields(own)} == set(kind.__struct_fields__)
        for kind, own in kinds
    )


class CheckedConnection(ServerConnection):
    """A connection that receives messages only if ``refusal`` (of the message's bytes) has no reason against them.

    ``refused`` is told the connection and the reason otherwise.
    """

    def __init__(
        self,
        *args: Any,
        refusal: Callable[[Any], str | None],
        refused: Callable[[ServerConnection, str], None],
        **more: Any,
    ) -> None:
        super().__init__(*args, **more)
        self._refusal, self._refused = refusal, refused

    async def recv(self, decode: bool | None = None) -> Any:
        while (reason := self._refusal(message := await super().recv(decode))) is not None:
            self._refused(self, reason)
        return message


def refusal(message: bytes | str, control: Callable[[str], Any]) -> str | None:
    """Why a message is not handed on; None for one that is.

    Args:
        control: viser's handle of a control by its number; None where there is none.
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
    handle = control(decoded.uuid)
    if handle is None:
        return "a control that is not there"
    reason = value_refusal(handle, decoded.updates.value)
    return None if reason is None else f"{getattr(handle, 'label', 'a control')}: {reason}"


def value_refusal(handle: Any, value: Any) -> str | None:
    """Why a control does not take a value, by what it was made with: its kind of value, choices and bounds."""
    now, props = handle._impl.value, handle._impl.props
    options, low, high = (getattr(props, name, None) for name in ("options", "min", "max"))
    if getattr(props, "disabled", False):
        return "cannot be set"
    if options is not None:
        return None if isinstance(value, str) and value in options else f"is not one of the {len(options)} choices"
    if isinstance(now, bool):
        return None if isinstance(value, bool) else "expected true or false"
    if isinstance(now, str):
        if not isinstance(value, str) or len(value) > _LONGEST:
            return f"expected a text of at most {_LONGEST} characters"
        return None
    if isinstance(now, int | float):
        return _number_refusal(now, value, low, high, getattr(props, "step", None))
    if isinstance(now, tuple):
        if not isinstance(value, list) or len(value) != len(now):
            return f"expected {len(now)} numbers"
        lows, highs = (side or (None,) * len(now) for side in (low, high))
        reasons = (_number_refusal(*one) for one in zip(now, value, lows, highs, strict=True))
        return next((reason for reason in reasons if reason is not None), None)
    return "takes no value"


def _number_refusal(
    now: float, value: Any, low: float | None, high: float | None, step: float | None = None
) -> str | None:
    kind = "a whole number" if isinstance(now, int) else "a number"
    slack = step / 2 if isinstance(now, float) and step is not None else 0.0  # a page rounds to the digits of its steps
    bounds = Range(None if low is None else low - slack, None if high is None else high + slack)
    whole = isinstance(value, int) or (
        isinstance(value, float) and math.isfinite(value) and (isinstance(now, float) or value.is_integer())
    )
    if whole and not isinstance(value, bool) and abs(value) <= 1e15 and bounds.accepts(value):
        return None
    return f"expected {Range(low, high).words(kind)}"
