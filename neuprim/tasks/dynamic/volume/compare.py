"""The model's extinction beside that of the files, on the files' own voxels."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from neuprim.core.model.primitives import Primitives
from neuprim.core.volumes.density_errors import NUMBERS, measure_frame_errors
from neuprim.tasks.dynamic.volume.truth import VolumeTruth

if TYPE_CHECKING:
    from neuprim.tasks.dynamic.volume.capture import Capture

__all__ = ["THIRDS", "compare_with_truth"]

THIRDS = ("early", "middle", "late")


def compare_with_truth(model: Primitives, capture: Capture, times: list[float], per_third: int = 3) -> dict[str, Any]:
    """Errors of sigma on all voxels of the sequence's box, for the early, middle and late third.

    ``sigma_frames`` has every compared frame, see :meth:`~neuprim.core.volumes.density_errors.Comparison.numbers`; the thirds
    are means over
    ``per_third`` of them, evenly spaced. Frames without any extinction are left out. Where flames add to the extinction
    of a grid, the same numbers are there of that grid's part, against its own values: ``density_frames``, ...
    """
    found: dict[str, Any] = {}
    for component in (None, *model.density.components(model.params)):
        found |= _compared(model, capture, times, per_third, component)
    return found


def _compared(
    model: Primitives, capture: Capture, times: list[float], per_third: int, component: str | None
) -> dict[str, Any]:
    count, truth = len(capture.frames), VolumeTruth(capture)
    chosen = sorted({int((i + 0.5) * count / (3 * per_third)) for i in range(3 * per_third)})
    entries: list[dict[str, Any]] = []
    for t in chosen:
        numbers = measure_frame_errors(
            model, {"time": torch.tensor(times[t])}, truth, t, where=capture.device, component=component
        )
        if numbers is not None:
            entries.append({"frame": capture.frames[t].number, "third": THIRDS[min(3 * t // count, 2)], **numbers})
    what = component or "sigma"
    result: dict[str, Any] = {f"{what}_frames": entries}
    for key in NUMBERS:
        for third in THIRDS:
            values = [e[key] for e in entries if e["third"] == third]
            result[f"{what}_{key}_{third}"] = float(np.mean(values)) if values else None
    return result
