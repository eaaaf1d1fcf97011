"""The backends that tests run over."""

from __future__ import annotations

from neuprim.core.render.backends import ORACLE, available

BACKENDS = [backend.name for backend in available()]
FAST = [name for name in BACKENDS if name != ORACLE]
"""Those that the oracle judges."""
