"""Warnings to the user: things that do not stop a command and should be known. One line each, said once per process.

They are Python warnings, so that notebooks and programs can filter them; the command line shows them as lines on
standard error.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class NeuprimWarning(UserWarning):
    """Something that a user should know and that stops nothing; its text is the whole message."""


_said: set[str] = set()


def warn_once(text: str) -> None:
    """Warns, unless this process has done so with the same words."""
    if text not in _said:
        _said.add(text)
        warnings.warn(text, NeuprimWarning, stacklevel=3)


@contextmanager
def warnings_as_lines() -> Iterator[None]:
    """Inside, our warnings are lines ``neuprim: warning: ...`` on standard error; other packages' stay as they are."""
    previous = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
        if issubclass(category, NeuprimWarning):
            print(f"neuprim: warning: {' '.join(str(message).split())}", file=sys.stderr)
        else:
            previous(message, category, *place, **more)

    warnings.showwarning = show
    try:
        yield
    finally:
        warnings.showwarning = previous
