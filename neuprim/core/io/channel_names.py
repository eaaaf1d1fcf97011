"""Names of an image's channels: which ones a file can hold, and those of images that have none."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

__all__ = ["default_names", "names_fault"]

LONGEST = 31
"""Bytes of a channel's name that every reader of OpenEXR takes."""


def default_names(count: int) -> tuple[str, ...]:
    """R, G, B for three channels, Y for one, else c0, c1, ..."""
    return {1: ("Y",), 3: ("R", "G", "B")}.get(count, tuple(f"c{i}" for i in range(count)))


def names_fault(names: Sequence[Any]) -> str | None:
    """``"WHAT; expected WHAT"`` of the first name that an OpenEXR file could not hold or would take for another's; None
    if all will do.

    A is left to alpha; whatever else is printable and at most 31 bytes long will do, ``450 nm`` for example.
    """
    seen: set[str] = set()
    for i, name in enumerate(names):
        if not isinstance(name, str):
            return f"[{i}] is of type {type(name).__name__}; expected text"
        if not name.strip() or name != name.strip() or not name.isprintable() or len(name.encode()) > LONGEST:
            return f"[{i}] is {name[:60]!r}; expected 1 to {LONGEST} bytes of printable text without blanks around it"
        if name == "A":
            return f"[{i}] is 'A'; expected another name, as A is alpha in OpenEXR files"
        if name in seen:
            return f"[{i}] is {name!r} once more; expected different names"
        seen.add(name)
    return None
