"""How much more memory a call takes while it works than before it, on the device that it works on."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import torch

__all__ = ["UNKNOWN", "peak_bytes"]

UNKNOWN = "the peak of a process's memory can be reset on Linux alone"

T = TypeVar("T")
_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def peak_bytes(call: Callable[[], T], card: torch.device | None = None) -> tuple[T, int | None]:
    """What a call returns, and by how many bytes memory in use rose at its peak; None where this system does not tell.

    On a card, what torch has given out. On the processor the resident set of the process, after memory that was freed
    has gone back to the system; whatever other threads of the process do meanwhile counts too.
    """
    if card is not None:
        torch.cuda.reset_peak_memory_stats(card)
        before = torch.cuda.memory_allocated(card)
        result = call()
        return result, max(0, torch.cuda.max_memory_allocated(card) - before)
    if not _reset():
        return call(), None
    resident = _kilobytes("VmRSS")
    result = call()
    peak = _kilobytes("VmHWM")
    return result, None if resident is None or peak is None else max(0, peak - resident) * 1024


def _reset() -> bool:
    """Bring the mark of the peak down to what is in use now."""
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (OSError, AttributeError, TypeError):
        pass  # another libc: what was freed may stay, and the rise looks smaller than it is
    try:
        _CLEAR.write_text("5")
    except OSError:
        return False
    return True


def _kilobytes(name: str) -> int | None:
    for line in _STATUS.read_text(encoding="utf-8").splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1])
    return None
