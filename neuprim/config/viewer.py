"""Settings of the live viewer of a training, ``viewer=true viewer.port=8080``; no file of a run has them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from neuprim.config.overrides import take_group
from neuprim.core.validation import Range, coerce, nonempty_text, validate, validate_fields

__all__ = ["LOOPBACK", "ViewerSettings", "take_viewer"]

LOOPBACK = "127.0.0.1"


@dataclass(frozen=True)
class ViewerSettings:
    """Where a viewer listens.

    Attributes:
        host: an address of this machine; the default is reached from this machine alone.
        port: 0 for any that is free.
    """

    host: Annotated[str, nonempty_text("an address of this machine")] = LOOPBACK
    port: Annotated[int, Range(0, 65535, says="a port, 1 to 65535, or 0 for any")] = 8080

    def __post_init__(self) -> None:
        validate_fields(self, "viewer")


def take_viewer(overrides: Sequence[str]) -> tuple[ViewerSettings | None, list[str]]:
    """Return the viewer that is asked for, None for none, and the other overrides; a host or port asks for one, too.

    Raises:
        ConfigError: no such setting, several values, or an impossible one.
    """
    values, others = take_group(overrides, "viewer")
    wanted = coerce(values.pop("", bool(values)), bool, "viewer")
    settings = validate(ViewerSettings, values, "viewer")
    return (settings if wanted else None), others
