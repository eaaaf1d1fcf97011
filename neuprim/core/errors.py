"""Errors that a user can correct, and warnings.

The command line prints an error that a user can correct as one line, and exits with status 2. Any other exception is a
bug and keeps its traceback. A warning does not stop a command. Each warning is one line, given once per process.
Warnings are Python warnings, so that notebooks and programs can filter them. The command line shows warnings on
standard error.
"""

from __future__ import annotations

import difflib
import errno
import sys
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

__all__ = ["BackendUnavailable", "CheckpointError", "ConfigError", "DataError", "DeviceMemoryError", "FormError"]
__all__ += ["NeuprimError", "NeuprimWarning", "NonFiniteError", "RankError", "warn_once"]

DISK = (
    *(errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.EIO),
    *(errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.ENAMETOOLONG, errno.ELOOP),
)
"""Codes of operating-system errors about disks and paths that users can correct. ENOENT is not among them, because a
missing file may be a bug."""


class NeuprimError(Exception):
    """Base class of all errors that the user can correct; the exception's text is the complete message."""


class DataError(NeuprimError):
    """A data set, image, camera or volume file is missing, damaged or inconsistent."""


class ConfigError(NeuprimError):
    """A setting, task, scene or preset does not exist or has an impossible value."""


class CheckpointError(NeuprimError):
    """A model or checkpoint file is damaged, or belongs to another program, version or task."""


class BackendUnavailable(NeuprimError):
    """The requested renderer backend or optional package cannot run on this machine."""


class NonFiniteError(NeuprimError):
    """A parameter, gradient, loss or image is NaN or infinite; the message says where the value is."""


class DeviceMemoryError(NeuprimError):
    """The memory of a GPU is full; the message says what uses the memory and which settings to lower."""


class RankError(NeuprimError):
    """Another process of the same distributed training ended, failed, or differs from this one.

    Attributes:
        reported: whether another rank has reported the error.
    """

    def __init__(self, message: str, reported: bool = False) -> None:
        super().__init__(message)
        self.reported = reported


class FormError(NeuprimError):
    """A field returned tensors of a wrong shape, type or device; the message names field, method and tensor."""


def cut_error_text(text: str, most: int = 80) -> str:
    """Shorten a text to at most ``most`` characters.

    Error messages shorten the values that they quote from files and users.
    """
    return text if len(text) <= most else f"{text[: most - 3]}..."


def nearest(name: str, choices: Iterable[str], limit: int = 3, prefix: str = "") -> str:
    """Return a hint for the end of an error message, such as ``"; did you mean 'a' or 'b'?"``.

    The hint lists the ``choices`` that are closest to ``name``, with ``prefix`` before each. If no choice is close, the
    hint lists all choices.
    """
    options = sorted(set(choices))
    close = difflib.get_close_matches(name[:200], options, n=limit, cutoff=0.5)
    if close:
        return "; did you mean " + " or ".join(repr(prefix + c) for c in close) + "?"
    return "; valid: " + ", ".join(prefix + o for o in options) if options else ""


_HEAD, _TAIL = 1200, 300
"""Number of characters kept at the beginning and at the end of a long message. The beginning names file and key."""

_FULL_GPU = (
    "the GPU's memory is full; expected a smaller image or grid, fewer primitives, or CUDA_VISIBLE_DEVICES= in the "
    "environment, which leaves GPUs out. What was saved is intact"
)


def one_line(error: BaseException) -> str | None:
    """Return the one-line message of an error that a user can correct; None for any other error, which is a bug."""
    if isinstance(error, NeuprimError):
        text = " ".join(str(error).split())
        return text if len(text) <= _HEAD + _TAIL else f"{text[:_HEAD]} ... {text[-_TAIL:]}"
    if isinstance(error, OSError) and error.errno in DISK:
        return f"{error.filename or 'writing'}: {error.strerror}"
    torch = sys.modules.get("torch")  # if it was not imported, it raised nothing
    if torch is not None and isinstance(error, torch.OutOfMemoryError):
        return _FULL_GPU
    return None


class NeuprimWarning(UserWarning):
    """A warning for the user, which does not stop the program; the warning's text is the complete message."""


_said: set[str] = set()


def warn_once(text: str) -> None:
    """Emit the warning ``text``, unless this process has emitted the same text before."""
    if text not in _said:
        _said.add(text)
        warnings.warn(text, NeuprimWarning, stacklevel=3)


@contextmanager
def warnings_as_lines() -> Iterator[None]:
    """Print neuprim's warnings inside the block as ``neuprim: warning: ...`` on standard error.

    Warnings of other packages are shown as before.
    """
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
