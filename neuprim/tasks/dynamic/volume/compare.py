"""The model's extinction beside that of the files. It learns from images; only its starting points were drawn from the files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from neuprim.core.model.primitives import Primitives
from neuprim.core.volumes.grid import agreement, density_grid, lattice
from neuprim.tasks.dynamic.volume.medium import Medium

if TYPE_CHECKING:
    from neuprim.tasks.dynamic.volume.capture import Capture

__all__ = ["RESOLUTION", "compare_with_truth", "extinction_on"]

RESOLUTION = 96
"""Points along the longest side of the box that both are compared on."""

THIRDS = ("early", "middle", "late")


def extinction_on(medium: Medium, scene_from_index: Tensor, shape: tuple[int, int, int]) -> np.ndarray:
    """(X, Y, Z) float32 extinction of the files at a lattice's points, trilinear."""
    if medium.values.size == 0:
        return np.zeros(shape, np.float32)
    index = np.indices(shape, dtype=np.float64).reshape(3, -1)
    chain = np.linalg.inv(medium.scene_from_index) @ scene_from_index.numpy()
    points = chain[:3, :3] @ index + chain[:3, 3:]
    found: np.ndarray = ndimage.map_coordinates(medium.values[..., 0], points, order=1, mode="constant", cval=0.0)
    return found.reshape(shape).astype(np.float32)


def compare_with_truth(model: Primitives, capture: Capture, times: list[float], per_third: int = 3) -> dict[str, Any]:
    """Pearson correlation and relative L2 error of sigma over the sequence's box, for the early, middle and late third.

    ``sigma_frames`` has every compared frame; the thirds are means over ``per_third`` of them, evenly spaced. Frames without
    any extinction have no correlation and are left out.
    """
    count = len(capture.frames)
    chosen = sorted({int((i + 0.5) * count / (3 * per_third)) for i in range(3 * per_third)})
    matrix, shape = lattice(capture.bounds, RESOLUTION)
    entries: list[dict[str, Any]] = []
    for t in chosen:
        truth = extinction_on(capture.medium(capture.frames[t]), matrix, shape)
        numbers = agreement(truth, density_grid(model, {"time": torch.tensor(times[t])}, matrix, shape).numpy())
        if numbers is not None:
            entries.append({"frame": capture.frames[t].number, "third": THIRDS[min(3 * t // count, 2)], **numbers})
    result: dict[str, Any] = {"sigma_frames": entries}
    for key in ("correlation", "relative_l2"):
        for third in THIRDS:
            values = [e[key] for e in entries if e["third"] == third]
            result[f"sigma_{key}_{third}"] = float(np.mean(values)) if values else None
    return result
