"""Colours of layers as bytes."""

from __future__ import annotations

import matplotlib
import numpy as np

from neuprim.inspect.layers import Painted, Scale

__all__ = ["painted", "table"]


def table(name: str, count: int = 256) -> np.ndarray:
    """(count, 3) uint8 colours of a colour map, from its lower to its upper end."""
    return np.asarray(np.rint(255 * matplotlib.colormaps[name](np.linspace(0, 1, count))[:, :3]).astype(np.uint8))


def painted(layer: Painted, count: int) -> np.ndarray:
    """(count, 3) uint8 colours of a layer's vertices, points or ellipsoids."""
    if layer.values is not None and layer.scale is not None:
        return on_scale(layer.values, layer.scale)
    colours = np.ones(3) if layer.colours is None else layer.colours
    return np.asarray(np.broadcast_to(np.rint(255 * colours).astype(np.uint8), (count, 3)))


def on_scale(values: np.ndarray, scale: Scale) -> np.ndarray:
    """(N, 3) uint8 colours of (N,) numbers."""
    part = np.clip((values.astype(np.float64) - scale.low) / (scale.high - scale.low), 0.0, 1.0)
    return table(scale.colours)[np.minimum((256 * part).astype(np.int64), 255)]
