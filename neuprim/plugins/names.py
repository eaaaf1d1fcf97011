"""How a plugin is chosen: by ``NAME``, or by ``PACKAGE:NAME`` where several packages claim the name."""

from __future__ import annotations

import re

__all__ = ["BUILT_IN", "normalised", "qualified", "split"]

BUILT_IN = "neuprim"
"""The distribution whose plugins are the built-in ones."""


def normalised(distribution: str) -> str:
    """A distribution's name as PEP 503 compares them: ``My_Package`` and ``my-package`` are one."""
    return re.sub(r"[-_.]+", "-", distribution).lower()


def split(word: str) -> tuple[str | None, str]:
    """(normalised package, name) of ``PACKAGE:NAME``; (None, name) of a bare name."""
    package, colon, name = word.partition(":")
    return (normalised(package.strip()), name.strip()) if colon else (None, word)


def qualified(distribution: str, name: str) -> str:
    """``PACKAGE:NAME``, as a user types it."""
    return f"{normalised(distribution)}:{name}"
