"""What metrics.json says, in one line."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from neuprim.core.metrics.image import from_json

__all__ = ["in_words"]

_LISTED = 6
"""Views that a line names; files name all."""


def in_words(metrics: Mapping[str, Any]) -> str:
    """What a mean hides, in one line: the worst view, and which are worse than an image of the background alone.

    The mean is over the views that are not exact, as that of an empty frame without any error is infinite.
    """
    worst, bad = from_json(metrics, "psnr_worst"), metrics["worse_than_black_image"]
    values = [value for entry in metrics["per_view"] if (value := from_json(entry, "psnr")) is not None]
    wrong = [value for value in values if math.isfinite(value)]
    exact = f", {len(values) - len(wrong)} exact" if len(wrong) < len(values) else ""
    mean = sum(wrong) / len(wrong) if wrong else math.inf
    text = f"PSNR of {len(values)} views{exact}: mean {mean:.2f} dB, worst {worst:.2f} dB ({metrics['view_worst']})"
    if not bad:
        return text
    more = f" and {len(bad) - _LISTED} more, see worse_than_black_image in metrics.json" if len(bad) > _LISTED else ""
    return f"{text}; worse than a black image: {len(bad)} of {len(values)} ({', '.join(bad[:_LISTED])}{more})"
