"""The backends that tests run over, and where each of them draws on this machine.

One that draws on a card draws on the processor where there is none, if it can: by the same code, slowly.
"""

from __future__ import annotations

from typing import Any

from neuprim.core.compute.device import CUDA, cuda_unavailable
from neuprim.core.render.backends import REFERENCE, TABLE, Backend


def _place(backend: Backend) -> str | None:
    """The kind of device that it can draw on here, its own first; None if there is none."""
    here = [kind for kind in backend.devices if kind != CUDA or cuda_unavailable() is None]
    return here[0] if here and backend.missing() is None else None


_PLACES = {backend.name: place for backend in TABLE if (place := _place(backend)) is not None}
LEFT_OUT = {
    backend.name: backend.missing() or str(cuda_unavailable()) for backend in TABLE if backend.name not in _PLACES
}
"""Why tests do not run over the others."""

BACKENDS = list(_PLACES)
FAST = [name for name in BACKENDS if name != REFERENCE]
"""Those that the oracle judges."""

SLOW_HERE = [name for name in FAST if next(b for b in TABLE if b.name == name).devices[0] != _PLACES[name]]
"""Those that are not where they are meant to be: they are given less to do."""


def by(name: str) -> dict[str, Any]:
    """The settings that have a backend draw here."""
    return {"backend": name, "device": _PLACES[name]}
