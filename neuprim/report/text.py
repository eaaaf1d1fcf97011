"""Values as text on the page. Everything that leaves here as HTML is escaped; what is missing is an en dash."""

from __future__ import annotations

import html
import json
import math
from collections.abc import Mapping, Sequence

from neuprim.report.record import number

__all__ = ["MISSING", "byte_size", "count", "decimal", "duration", "escape", "setting"]

MISSING = "–"


def escape(value: object) -> str:
    """``value`` as HTML text that is also safe inside a quoted attribute."""
    return MISSING if value is None or value == "" else html.escape(setting(value), quote=True)


def setting(value: object) -> str:
    """A setting as one would type it: ``true``, ``null``, ``0.001``, ``[1, 2]``; strings bare. Not escaped."""
    if isinstance(value, str):
        return value
    if value is None or isinstance(value, bool | int | float | Sequence | Mapping):
        return json.dumps(value, ensure_ascii=False, default=str)
    return str(value)


def decimal(value: float | None, digits: int) -> str:
    """A fixed number of decimals; the infinity sign for infinite values."""
    if value is None:
        return MISSING
    return f"{value:,.{digits}f}" if math.isfinite(value) else ("∞" if value > 0 else "−∞")


def count(value: object) -> str:
    """A whole number with thousands separated; other numbers keep up to two decimals."""
    found = number(value)
    if found is None or not math.isfinite(found):
        return MISSING
    return f"{round(found):,}" if found == round(found) else f"{found:,.2f}"


def byte_size(value: object) -> tuple[str, str]:
    """(number, unit) of a size in bytes, in powers of 1000."""
    found = number(value)
    if found is None or not math.isfinite(found):
        return MISSING, ""
    for unit in ("B", "kB", "MB"):
        if abs(found) < 1000:
            return (f"{found:.0f}" if unit == "B" else f"{found:.3g}" if found < 100 else f"{found:.0f}"), unit
        found /= 1000
    return f"{found:,.2f}", "GB"


def duration(seconds: object) -> str:
    """``8.3 s``, ``4 min 07 s`` or ``2 h 05 min``."""
    found = number(seconds)
    if found is None or not math.isfinite(found) or found < 0:
        return MISSING
    if found < 59.95:
        return f"{found:.1f} s"
    whole = round(found)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    minutes = round(found / 60)
    return f"{minutes // 60} h {minutes % 60:02d} min"
